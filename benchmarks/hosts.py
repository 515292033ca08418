"""Hosts and lines on one machine: network namespaces, and a relay that carries packets between them as a line would.

Each host has its own addresses, ports and names. A line takes IP packets from a TUN device of one host and gives them
to one of the other: late, at a limited rate, or not at all. Needs Linux, root, and the program `ip`.
"""

import fcntl
import heapq
import itertools
import os
import random
import select
import shutil
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fedvla_lib.engines import processes

DEVICE, RUNNING, NAMES = Path("/dev/net/tun"), Path("/run/netns"), Path("/etc/netns")
TUNSETIFF, TUN_WITHOUT_HEADER = 0x400454CA, 0x1001  # of linux/if_tun.h
PACKET = 65_536
MTU = "1400"
BACKLOG_S = 1.0  # a line that is this far behind drops what comes, as routers do


def refusal() -> str:
    """Return why no network can be made here, or an empty string."""
    if sys.platform != "linux" or os.geteuid() != 0:
        return "network namespaces need Linux and root"
    if not shutil.which("ip") or not DEVICE.exists():
        return f"network namespaces need the program ip, and {DEVICE}"
    probe = f"fedvla-probe-{os.getpid()}"
    try:
        for words in (["add", probe], ["exec", probe, "true"]):
            done = subprocess.run(["ip", "netns", *words], capture_output=True, text=True)
            if done.returncode:
                return f"ip netns {' '.join(words)}: {done.stderr.strip()}"
    finally:
        subprocess.run(["ip", "netns", "del", probe], capture_output=True)
    return ""


@dataclass(frozen=True)
class Host:
    """A network namespace."""

    name: str

    def start(self, command: Sequence[str], environment: dict[str, str], log: Path) -> subprocess.Popen:
        """Start a program on this host."""
        return processes.start(["ip", "netns", "exec", self.name, *command], environment, log)

    def call(self, function: Callable[[], Any]) -> Any:
        """Call a function in a thread on this host; what it starts and opens is there too."""
        with ThreadPoolExecutor(1, initializer=enter, initargs=(self,)) as threads:
            return threads.submit(function).result()

    def know(self, names: Mapping[str, str]) -> None:
        """Set what addresses names stand for; no other name is known here."""
        lines = [f"{address}\t{name}" for name, address in {"localhost": "127.0.0.1", **names}.items()]
        (NAMES / self.name / "hosts").write_text("\n".join(lines) + "\n")  # in place: running programs see it


def enter(host: Host) -> None:
    """Move this thread, and what it starts, to a host."""
    with open(RUNNING / host.name) as namespace:
        os.setns(namespace.fileno(), os.CLONE_NEWNET)


class Line(threading.Thread):
    """Carries packets between two hosts; what it does to them may be changed at any time.

    Attributes:
        delay_s: seconds each way.
        loss: share of packets that are lost.
        bytes_per_s: each way; 0 is without a limit.
        is_cut: nothing arrives.
        carried: bytes delivered to the right host, and to the left.
        lost: packets that did not arrive, whatever the reason.
        late: packets that waited for others to pass a narrow line.
    """

    def __init__(self, number: int, left: Host, right: Host) -> None:
        """Make the devices: the left host has address 10.77.number.1 on this line, the right one 10.77.number.2."""
        super().__init__(daemon=True)
        self.address = f"10.77.{number}.1"
        self.carried, self._free_at, self._rng = [0, 0], [0.0, 0.0], random.Random(number)
        self.lost = self.late = 0
        self._due: list[tuple[float, int, int, bytes]] = []
        self._order, self._closing = itertools.count(), threading.Event()
        self._ends = [host.call(lambda name=f"line{number}": _tun(name)) for host in (left, right)]
        for host, address in ((left, self.address), (right, f"10.77.{number}.2")):
            _ip("-n", host.name, "address", "add", f"{address}/30", "dev", f"line{number}")
            _ip("-n", host.name, "link", "set", f"line{number}", "mtu", MTU, "up")
        self.mend()

    def mend(self) -> None:
        """Make it a good line again."""
        self.delay_s, self.loss, self.bytes_per_s, self.is_cut = 0.0, 0.0, 0.0, False

    def run(self) -> None:
        """Carry until closed."""
        while not self._closing.is_set():
            wait_s = min(max(0.0, self._due[0][0] - time.monotonic()), 0.1) if self._due else 0.1
            for end in select.select(self._ends, [], [], wait_s)[0]:
                self._take(1 - self._ends.index(end), os.read(end, PACKET))
            while self._due and self._due[0][0] <= time.monotonic():
                _, _, to, packet = heapq.heappop(self._due)
                try:
                    self.carried[1 - to] += os.write(self._ends[to], packet)
                except BlockingIOError:  # the device is full: lost, as in a router
                    self.lost += 1
        for end in self._ends:
            os.close(end)

    def _take(self, to: int, packet: bytes) -> None:
        now = time.monotonic()
        sent_at = max(now, self._free_at[to]) + (len(packet) / self.bytes_per_s if self.bytes_per_s else 0.0)
        if self.is_cut or self._rng.random() < self.loss or sent_at - now > BACKLOG_S:
            self.lost += 1
            return
        self.late += self._free_at[to] > now
        self._free_at[to] = sent_at
        heapq.heappush(self._due, (sent_at + self.delay_s, next(self._order), to, packet))

    def close(self) -> None:
        """Stop, and remove the devices."""
        self._closing.set()
        if self.is_alive():
            self.join()


def _tun(name: str) -> int:
    device = os.open(DEVICE, os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH", name.encode(), TUN_WITHOUT_HEADER))
    return device


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


@contextmanager
def network(count: int) -> Iterator[tuple[Host, list[Host], list[Line]]]:
    """Yield a central host, `count` others, and the line from the centre to each; remove them at the end."""
    hosts = [Host(f"fedvla-{os.getpid()}-{k}") for k in range(count + 1)]
    lines: list[Line] = []
    try:
        for host in hosts:
            _ip("netns", "add", host.name)
            _ip("-n", host.name, "link", "set", "lo", "up")
            (NAMES / host.name).mkdir(parents=True)
            (NAMES / host.name / "resolv.conf").write_text("nameserver 127.0.0.1\n")  # where nobody answers
            host.know({})
        for number, host in enumerate(hosts[1:], 1):
            lines.append(Line(number, hosts[0], host))
            lines[-1].start()
        yield hosts[0], hosts[1:], lines
    finally:
        for line in lines:
            line.close()
        for host in hosts:
            subprocess.run(["ip", "netns", "del", host.name], check=False, capture_output=True)
            shutil.rmtree(NAMES / host.name, ignore_errors=True)
