"""What a bad network does to a federation: a SuperLink and three SuperNodes on hosts of their own, in all weathers.

    python benchmarks/network.py --profile tiny        as root, on Linux

Most cases are runs of two rounds that start on a good network, which gets worse when clients begin to train. Such a run
is as good as undisturbed if its model is that of the inline engine, which has no network. A promise counts as kept only
if the lines say that the weather struck: packets were lost or late, and each node's traffic went through its line.
"""

import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

from fedvla_lib import run_folder
from fedvla_lib.config import Config
from fedvla_lib.data import recordings
from fedvla_lib.engines import credentials, deployment, processes, superlink
from fedvla_lib.engines.inline import run_inline
from fedvla_lib.engines.warm_start import warm_start
from hosts import Host, Line, enter, network, refusal
from report import RESULTS, laptop, options, report, start

CLIENTS, ROUNDS, SERVER = 3, 2, "server.example.org"
TIMEOUT_S = 900.0
BACK_S = 45.0  # a node reports every half minute
OUTAGE_S = 120.0
LEAST_BYTES = 1_000_000  # through each line: less than a model
SAME = f"{ROUNDS} rounds of {CLIENTS} clients, the model of a run without a network"
GONE = f"{ROUNDS} rounds of {CLIENTS - 1} clients; client_2: silent"
ONE_PORT = f"the server's port, and no other on any host; {SAME}"


@dataclass
class Remote(deployment.Deployment):
    """A deployment whose SuperNodes have hosts of their own."""

    hosts: list[Host] = field(default_factory=list)
    lines: list[Line] = field(default_factory=list)
    environments: list[dict[str, str]] = field(default_factory=list)
    centre: Host | None = None

    def launch_node(self, partition_id: int) -> None:
        """Start the SuperNode of a client on its host, and do not wait."""
        (log := self.log(partition_id)).unlink(missing_ok=True)
        environment = self.environments[partition_id]
        command = [re.sub(r"^127\.0\.0\.1(?=:)", SERVER, word) for word in self._command(partition_id)]
        self.nodes[partition_id] = self.hosts[partition_id].start(command, environment, log)

    def resolve(self, partition_id: int) -> None:
        """Let a host know where the server is."""
        self.hosts[partition_id].know({SERVER: self.lines[partition_id].address})


@contextmanager
def federation(folder: Path, hosts: list[Host], lines: list[Line], centre: Host) -> Iterator[Remote]:
    """Yield a SuperLink on the central host, where this process is, and a SuperNode on each of the others."""
    folder.mkdir(exist_ok=True)
    files = credentials.make_server(folder / "server", [SERVER])
    keys = [credentials.make_node_key(folder / "keys", f"node_{k}") for k in range(len(hosts))]
    with ExitStack() as last:
        environments = []
        for k, host in enumerate(hosts):  # programs of a node are forked from a server on its host
            (home := folder / f"node_{k}").mkdir()
            warm = warm_start(superlink.flower_environment(home), home / "fork_server.log")
            environments.append(host.call(warm.__enter__))
            last.push(warm.__exit__)
        link = last.enter_context(
            superlink.local_superlink(folder, "--enable-supernode-auth", files=files, host="0.0.0.0")
        )
        remote = Remote(link, folder, [], keys, len(hosts), {}, hosts, lines, environments, centre)
        last.callback(remote.kill_nodes)
        for k in range(len(hosts)):
            link.ask("supernode", "register", str(keys[k].public), superlink.CONNECTION)
            remote.resolve(k)
            remote.launch_node(k)
        for k in range(len(hosts)):
            remote.wait_for_node(k)
        yield remote


def slow(remote: Remote, _: float) -> None:
    """0.1 s each way, and one packet of twenty is lost."""
    for line in remote.lines:
        line.delay_s, line.loss = 0.1, 0.05


def narrow(remote: Remote, _: float) -> None:
    """1 Mbit/s each way."""
    for line in remote.lines:
        line.bytes_per_s = 1e6 / 8


def away(remote: Remote, since_s: float) -> None:
    """One node is cut off for 20 s."""
    remote.lines[2].is_cut = since_s < 20


def gone(remote: Remote, _: float) -> None:
    """One node is cut off and stays so."""
    remote.lines[2].is_cut = True


def server_away(remote: Remote, since_s: float, until_s: float) -> None:
    """The server's host is cut off for some time."""
    for line in remote.lines:
        line.is_cut = since_s < until_s


def renew(remote: Remote, _: float) -> None:
    """The certificate and a node's key are replaced on disk, and the new authority is trusted beside the old one."""
    if not (remote.folder / "server/new").exists():
        new, old = credentials.make_server(remote.folder / "server/new", [SERVER]), remote.link.files
        old.authority.write_bytes(old.authority.read_bytes() + new.authority.read_bytes())
        shutil.copy(new.certificate, old.certificate)
        shutil.copy(new.key, old.key)
        key = credentials.make_node_key(remote.folder / "keys", "node_1")
        remote.link.ask("supernode", "register", str(key.public), superlink.CONNECTION)


def in_weather(remote: Remote, config: Config, alone: Path, weather: Callable[[Remote, float], None]) -> str:
    """Run a federation; the weather is told the seconds since clients began to train. Say what happened."""
    before, began = run_folder.run_folders(config), []

    def watch() -> None:
        root = run_folder.own_run(config, before)
        if not began and root and (root / "checkpoints/round_0").is_dir():
            began.append(datetime.now(UTC))
        if began:
            weather(remote, (datetime.now(UTC) - began[0]).total_seconds())

    remote.run(config, TIMEOUT_S, watch)
    root = run_folder.own_run(config, before)
    late = not began or began[0] > training_times(root)[0]
    return told(root, alone) + "; the weather came too late" * late


def training_times(root: Path) -> list[datetime]:
    """Return when the server had the first and the last update of a run."""
    times = sorted(run_folder.read_metrics(root, "train").time)
    return [datetime.fromisoformat(times[i]) for i in (0, -1)]


def resumed(remote: Remote, config: Config, alone: Path) -> str:
    """Cut the server's host off for longer than Flower waits for anybody, and resume the run on a good network."""
    before, cut = run_folder.run_folders(config), []

    def weather(of: Remote, since_s: float) -> None:
        cut.append(time.monotonic())
        server_away(of, since_s, OUTAGE_S)

    try:
        return in_weather(remote, config, alone, weather)
    except processes.FlowerRunError:
        root = run_folder.own_run(config, before)
    status = run_folder.read_stamp(root)["status"]
    time.sleep(max(0.0, cut[0] + OUTAGE_S - time.monotonic()))
    for line in remote.lines:
        line.mend()
    time.sleep(BACK_S)
    again = replace(config, resume=str(root))
    remote.run(again, TIMEOUT_S)
    return f"{':'.join(status.split(':')[:2])}; resumed, {told(root, alone)}"


def renewed(remote: Remote, config: Config, alone: Path) -> str:
    """Replace certificate and key during a run, then restart that node, which runs with its new key."""
    first = in_weather(remote, config, alone, renew)
    if not (remote.folder / "server/new").exists():
        return "nothing was replaced"
    processes.stop(remote.nodes[1])
    remote.launch_node(1)
    remote.wait_for_node(1)
    return f"{first}; node restarted, {in_weather(remote, config, alone, lambda *_: None)}"


def nameless(remote: Remote, config: Config, alone: Path) -> str:
    """Restart a node on a host that does not know the server's name until 20 s later."""
    processes.stop(remote.nodes[0])
    remote.hosts[0].know({})
    remote.launch_node(0)
    time.sleep(20)
    said = remote.log(0).read_text()
    tries = "Connection attempt failed" in said and deployment.CONNECTED not in said and remote.nodes[0].poll() is None
    remote.resolve(0)
    remote.wait_for_node(0)
    return f"joins; {in_weather(remote, config, alone, lambda *_: None)}" if tries else "the name was not missed"


def twice(remote: Remote, config: Config, alone: Path) -> str:
    """Run a second federation with a SuperLink and SuperNodes of its own on the same hosts, at the same time."""

    def one(of: Remote, name: str) -> tuple[str, list[datetime]]:
        own = replace(config, out=f"{config.out}_{name}")
        said = in_weather(of, own, alone, lambda *_: None)
        return said, training_times(max(run_folder.run_folders(own)))

    with (
        federation(remote.folder / "second", remote.hosts, remote.lines, remote.centre) as second,
        ThreadPoolExecutor(2) as threads,
    ):
        (said, times), (other, others) = threads.map(one, (remote, second), ("first", "second"))
    together = max(times[0], others[0]) < min(times[1], others[1])
    return (said if said == other else f"{said}; {other}") + "; one after the other" * (not together)


def listening(remote: Remote, config: Config, alone: Path) -> str:
    """List the ports that others can reach while a run goes on, on the server's host and on those of the nodes."""
    found: dict[str, set[int]] = {host.name: set() for host in (remote.centre, *remote.hosts)}

    def look(of: Remote, _: float) -> None:
        for host in (of.centre, *of.hosts):
            found[host.name].update(sockets(host))

    said = in_weather(remote, config, alone, look)
    server = found.pop(remote.centre.name)
    others = [*server - {remote.link.port}, *(port for ports in found.values() for port in ports)]
    one = remote.link.port in server and not others
    return f"the server's port, and {'no other on any host' if one else f'others: {others}'}; {said}"


def sockets(host: Host) -> list[int]:
    """Return the ports, of TCP and UDP, on which a host listens, loopback aside."""
    lines = host.call(lambda: subprocess.run(["ss", "-ltunH"], capture_output=True, text=True, check=True).stdout)
    places = [line.split()[4].rpartition(":") for line in lines.splitlines()]
    return [int(port) for address, _, port in places if not address.startswith(("127.", "[::1]"))]


Happens = Callable[[Remote, Config, Path], str]
# What the network does: what is promised, what shows what happens, and which trace the weather leaves on the lines.
CASES: dict[str, tuple[str, Happens, str]] = {
    "good": (SAME, partial(in_weather, weather=lambda *_: None), ""),
    "0.1 s each way, 5 % of packets lost": (SAME, partial(in_weather, weather=slow), "lost"),
    "1 Mbit/s each way": (SAME, partial(in_weather, weather=narrow), "late"),
    "a node cut off for 20 s during a round": (SAME, partial(in_weather, weather=away), "lost"),
    "the server cut off for 20 s during a round": (
        SAME, partial(in_weather, weather=partial(server_away, until_s=20)), "lost",
    ),
    "the server cut off for two minutes during a round": (f"failed: TooFewReplies; resumed, {SAME}", resumed, "lost"),
    "a node cannot resolve the server's name for 20 s": (f"joins; {SAME}", nameless, ""),
    "two federations on the same hosts": (SAME, twice, ""),
    "the server's certificate and a node's key replaced during a round": (
        f"{SAME}; node restarted, {SAME}", renewed, "",
    ),
    "open ports during a run": (ONE_PORT, listening, ""),
    "a node cut off during a round, permanently": (GONE, partial(in_weather, weather=gone), "lost"),
}  # fmt: skip


def main() -> None:
    """Try every case and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), help="cases to try")
    chosen = parser.parse_args()
    if why := refusal():
        raise ValueError(why)
    if chosen.only != list(CASES) and chosen.out == RESULTS:
        raise ValueError("--only would leave cases out of the stored table: give another --out")
    for number in (signal.SIGTERM, signal.SIGHUP):  # as at Ctrl-C, hosts and keys are removed
        signal.signal(number, lambda *_: sys.exit(1))
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as name, network(CLIENTS) as (centre, hosts, lines):
        folder = Path(name)
        config = laptop(
            chosen.profile, num_clients=CLIENTS, num_server_rounds=ROUNDS, fraction_train=1.0, fraction_evaluate=0.0,
            eval_rollouts=0, client_rollouts=0, out=str(folder / "runs"),
        )  # fmt: skip
        config = replace(config, data=str(recordings.resolve(config)))
        alone = run_inline(replace(config, out=str(folder / "inline")), progress=False)
        enter(centre)
        with federation(folder / "federation", hosts, lines, centre) as remote:
            for case in chosen.only:
                rows.append({"the network": case, **tried(remote, config, *CASES[case], alone)})
                print(rows[-1], flush=True)
    report("network", rows, chosen.out)
    if broken := [row["the network"] for row in rows if not row["kept"]]:
        raise ValueError(f"not as promised: {', '.join(broken)}")


def tried(
    remote: Remote, config: Config, promised: str, happens: Happens, trace: str, alone: Path
) -> dict[str, object]:
    """Return what was promised, what happened, and what it cost."""
    for line in remote.lines:
        line.lost = line.late = 0
    carried, began = [sum(line.carried) for line in remote.lines], time.monotonic()
    try:
        happened = happens(remote, config, alone)
    except processes.FlowerRunError as error:
        happened = type(error).__name__
    for line in remote.lines:
        line.mend()
    moved = [sum(line.carried) - was for line, was in zip(remote.lines, carried, strict=True)]
    there = CLIENTS - promised.count("silent")  # one that is gone may have been cut off before its model came
    struck = sorted(moved)[-there] > LEAST_BYTES and (not trace or any(getattr(line, trace) for line in remote.lines))
    return {
        "promised": promised, "happened": happened, "kept": happened == promised and struck,
        "time [s]": time.monotonic() - began, "through the busiest line [MB]": max(moved) / 1e6,
        "packets lost": sum(line.lost for line in remote.lines),
    }  # fmt: skip


def told(root: Path, alone: Path) -> str:
    """Say what a run did, in the words of the promises."""
    trained, rejected = run_folder.read_metrics(root, "train"), run_folder.read_metrics(root, "rejected")
    counts = trained.groupby("round").who.nunique()
    said = f"{len(counts)} rounds of {' and '.join(map(str, sorted(set(counts))))} clients"
    left, right = (load_file(one / f"global_model/round_{ROUNDS}/model.safetensors") for one in (root, alone))
    if left.keys() == right.keys() and all(np.allclose(left[name], right[name], 0, 1e-6) for name in left):
        said += ", the model of a run without a network"
    named = dict.fromkeys(f"{row.who}: {row.reason}" for row in rejected.itertuples())
    return "; ".join([said, *named])


if __name__ == "__main__":
    start(main)
