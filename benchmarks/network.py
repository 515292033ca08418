"""What a bad network does to a federation: a SuperLink and three SuperNodes on hosts of their own, in all weathers.

    python benchmarks/network.py --profile tiny        as root, on Linux

Most cases are runs of two rounds that start on a good network, which gets worse when clients begin to train. Such a run
is as good as undisturbed if its model is that of the inline engine, which has no network.
"""

import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
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
from report import laptop, options, report, start

CLIENTS, ROUNDS, SERVER = 3, 2, "server.example.org"
TIMEOUT_S = 900.0
BACK_S = 45.0  # a node reports every half minute
ONE_PORT = "the server's port, and no other on any host"
SAME = f"{ROUNDS} rounds of {CLIENTS} clients, the model of a run without a network"
GONE = f"{ROUNDS} rounds of {CLIENTS - 1} clients; client_2: silent"


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


def exchanged(remote: Remote, since_s: float) -> None:
    """The certificate and a node's key are replaced on disk, and the new authority is trusted beside the old one."""
    if not (remote.folder / "new").exists():
        new, old = credentials.make_server(remote.folder / "new", [SERVER]), remote.link.files
        old.authority.write_bytes(old.authority.read_bytes() + new.authority.read_bytes())
        shutil.copy(new.certificate, old.certificate)
        shutil.copy(new.key, old.key)
        key = credentials.make_node_key(remote.folder / "keys", "node_1")
        remote.link.ask("supernode", "register", str(key.public), superlink.CONNECTION)


def in_weather(remote: Remote, config: Config, alone: Path, weather: Callable[[Remote, float], None]) -> str:
    """Run a federation; the weather is told the seconds since clients began to train. Say what happened."""
    before, trained = run_folder.run_folders(config), []

    def watch() -> None:
        root = run_folder.own_run(config, before)
        if not trained and root and (root / "checkpoints/round_0").is_dir():
            trained.append(time.monotonic())
        if trained:
            weather(remote, time.monotonic() - trained[0])

    remote.run(config, TIMEOUT_S, watch)
    return told(run_folder.own_run(config, before), alone)


def resumed(remote: Remote, config: Config, alone: Path) -> str:
    """Cut the server's host off for longer than Flower waits for anybody, and resume the run on a good network."""
    before = run_folder.run_folders(config)
    try:
        return in_weather(remote, config, alone, partial(server_away, until_s=120))
    except processes.FlowerRunError:
        root = run_folder.own_run(config, before)
    status = run_folder.read_stamp(root)["status"]
    for line in remote.lines:
        line.mend()
    time.sleep(BACK_S)
    good = in_weather(remote, replace(config, resume=str(root)), alone, lambda *_: None)
    return f"{status.split(':')[0]}, and says why; resumed, {good}"


def nameless(remote: Remote, config: Config, alone: Path) -> str:
    """Restart a node on a host that does not know the server's name until 20 s later."""
    processes.stop(remote.nodes[0])
    remote.hosts[0].know({})
    remote.launch_node(0)
    time.sleep(20)
    early = deployment.CONNECTED in remote.log(0).read_text()
    remote.resolve(0)
    remote.wait_for_node(0)
    return "joins too early" if early else f"joins; {in_weather(remote, config, alone, lambda *_: None)}"


def twice(remote: Remote, config: Config, alone: Path) -> str:
    """Run a second federation with a SuperLink and SuperNodes of its own on the same hosts, at the same time."""

    def one(of: Remote, name: str) -> str:
        return in_weather(of, replace(config, out=f"{config.out}_{name}"), alone, lambda *_: None)

    with (
        federation(remote.folder / "second", remote.hosts, remote.lines, remote.centre) as second,
        ThreadPoolExecutor(2) as threads,
    ):
        said = list(threads.map(one, (remote, second), ("first", "second")))
    return said[0] if said[0] == said[1] else "; ".join(said)


def listening(remote: Remote, *_: object) -> str:
    """List the ports that others can reach, on the server's host and on those of the nodes."""
    found = [sockets(remote.centre), *map(sockets, remote.hosts)]
    of_server = [port for port in found[0] if port != remote.link.port]
    others = [port for ports in [of_server, *found[1:]] for port in ports]
    return f"others open: {others}" if others or remote.link.port not in found[0] else ONE_PORT


def sockets(host: Host) -> list[int]:
    """Return the ports on which a host listens, loopback aside."""
    lines = host.call(lambda: subprocess.run(["ss", "-ltnH"], capture_output=True, text=True, check=True).stdout)
    places = [line.split()[3].rpartition(":") for line in lines.splitlines()]
    return [int(port) for address, _, port in places if not address.startswith(("127.", "[::1]"))]


Happens = Callable[[Remote, Config, Path], str]
# What the network does: what is promised, and what shows what happens. A run's weather begins when its clients train.
CASES: dict[str, tuple[str, Happens]] = {
    "good": (SAME, partial(in_weather, weather=lambda *_: None)),
    "0.1 s each way, 5 % of packets lost": (SAME, partial(in_weather, weather=slow)),
    "1 Mbit/s each way": (SAME, partial(in_weather, weather=narrow)),
    "a node cut off for 20 s in mid-round": (SAME, partial(in_weather, weather=away)),
    "the server cut off for 20 s in mid-round": (SAME, partial(in_weather, weather=partial(server_away, until_s=20))),
    "the server cut off for two minutes in mid-round": (f"failed, and says why; resumed, {SAME}", resumed),
    "a node does not find the server's name for 20 s": (f"joins; {SAME}", nameless),
    "two federations on the same hosts": (SAME, twice),
    "certificates and a node's key exchanged in mid-round": (SAME, partial(in_weather, weather=exchanged)),
    "which ports others can reach": (ONE_PORT, listening),
    "a node cut off in mid-round, and for good": (GONE, partial(in_weather, weather=gone)),
}


def main() -> None:
    """Try every case and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES), help="cases to try")
    chosen = parser.parse_args()
    if why := refusal():
        raise ValueError(why)
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
                report("network", rows, chosen.out)  # each time: the whole takes minutes


def tried(remote: Remote, config: Config, promised: str, happens: Happens, alone: Path) -> dict[str, object]:
    """Return what was promised, what happened, and what it cost."""
    carried, began = [sum(line.carried) for line in remote.lines], time.monotonic()
    try:
        happened = happens(remote, config, alone)
    except processes.FlowerRunError as error:
        happened = str(error)
    for line in remote.lines:
        line.mend()
    moved = [sum(line.carried) - was for line, was in zip(remote.lines, carried, strict=True)]
    return {
        "promised": promised, "happened": happened, "kept": happened == promised,
        "time [s]": time.monotonic() - began, "through a node's line [MB]": max(moved) / 1e6,
    }  # fmt: skip


def told(root: Path, alone: Path) -> str:
    """Say what a run did, in the words of the promises."""
    trained, rejected = run_folder.read_metrics(root, "train"), run_folder.read_metrics(root, "rejected")
    counts = trained.groupby("round").who.nunique()
    said = f"{len(counts)} rounds of {' and '.join(map(str, sorted(set(counts))))} clients"
    left, right = (load_file(one / f"global_model/round_{ROUNDS}/model.safetensors") for one in (root, alone))
    if max(np.abs(left[name] - right[name]).max() for name in left) <= 1e-6:
        said += ", the model of a run without a network"
    named = dict.fromkeys(f"{row.who}: {row.reason}" for row in rejected.itertuples())
    return "; ".join([said, *named])


if __name__ == "__main__":
    start(main)
