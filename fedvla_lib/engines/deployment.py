"""A deployment on this machine: a SuperLink and one SuperNode per client, each in its own process.

A deployment on several hosts differs only in the address and in who starts the processes; certificates, keys, node
config and app are the same. All processes are stopped at the end, even on Ctrl-C or when the run fails.
"""

import json
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from fedvla_lib import run_folder
from fedvla_lib.config import Config, absolute, check
from fedvla_lib.engines import app_bundle, credentials, guard, processes, superlink
from fedvla_lib.engines.processes import FlowerRunError
from fedvla_lib.engines.superlink import CONNECTION, SuperLink
from fedvla_lib.federation import messages

HOME = "fedvla-deploy-"  # begins the names of temporary folders
CONNECTED = "SuperNode ID:"  # logged by a SuperNode once the SuperLink has accepted it
UNTRUSTED = "CERTIFICATE_VERIFY_FAILED"  # logged at each try by a SuperNode that does not trust the SuperLink
print_line = partial(print, flush=True)  # at once, also into a pipe
REPORTED = ("loss", "success_rate", "num_examples", "reason", "detail")


@dataclass
class Deployment:
    """A running SuperLink and its SuperNodes, one per client, by partition id."""

    link: SuperLink
    folder: Path
    data: Sequence[Path]  # data set of each node; empty: nodes use `config.data`
    keys: list[credentials.NodeKey]  # of each node; empty without authentication
    num_clients: int
    nodes: dict[int, subprocess.Popen] = field(default_factory=dict)

    def log(self, partition_id: int) -> Path:
        """Return the path of a node's log."""
        return self.folder / f"node_{partition_id}" / "supernode.log"

    def launch_node(self, partition_id: int) -> None:
        """Start the SuperNode of a client with a new log, and do not wait."""
        log = self.log(partition_id)
        log.parent.mkdir(exist_ok=True)
        log.unlink(missing_ok=True)
        environment = {**self.link.environment, "FLWR_HOME": str(log.parent)}
        self.nodes[partition_id] = processes.start(self._command(partition_id), environment, log)

    def wait_for_node(self, partition_id: int) -> None:
        """Wait until the SuperLink has accepted a SuperNode.

        A SuperLink rejects a key until it notices that the previous node with that key is gone, so whoever restarts a
        node has to try again for up to two minutes, as service managers do.

        Raises:
            FlowerRunError: the SuperLink rejected it, it rejected the SuperLink, or could not connect; with its log.
        """
        node, log, who = self.nodes[partition_id], self.log(partition_id), f"the SuperNode of client {partition_id}"
        processes.wait_until(lambda: _says(log, CONNECTED) or _says(log, UNTRUSTED), node, log, who)
        if not _says(log, CONNECTED):  # it would retry forever
            raise FlowerRunError(f"{who} does not trust the SuperLink; {processes.reason(log)}")

    def run(self, config: Config, timeout_s: float, watch: Callable[[], None] = lambda: None) -> None:
        """Run the app and wait until it ends; raise FlowerRunError if it failed or timed out."""
        if self.keys:
            config = replace(config, node_keys=str(self.keys[0].public.parent))
        app = app_bundle.stage_app(self.folder, config)
        superlink.require_completed(self.link, self.link.submit(app, timeout_s=timeout_s, watch=watch))

    def kill_nodes(self) -> None:
        """Kill the SuperNodes, which would otherwise spend a long time signing off from the SuperLink."""
        for node in self.nodes.values():
            processes.stop(node, (signal.SIGKILL,))

    def _command(self, partition_id: int) -> list[str]:
        node_config = f"partition-id={partition_id} num-partitions={self.num_clients}"
        if self.data:
            node_config += f" data={json.dumps(str(self.data[partition_id]))}"
        trust = ["--root-certificates", str(self.link.files.authority)] if self.link.files else ["--insecure"]
        if self.keys:
            node_config += f" {messages.KEY}={json.dumps(str(self.keys[partition_id].private))}"
            trust += ["--auth-supernode-private-key", str(self.keys[partition_id].private)]
        address, port = f"127.0.0.1:{self.link.port}", str(processes.free_port())
        return ["flower-supernode", *trust, "--superlink", address, "--node-config", node_config, "--port", port]


@contextmanager
def running_deployment(
    folder: Path, num_clients: int, *, tls: bool = True, auth: bool = True, data: Sequence[Path] = ()
) -> Iterator[Deployment]:
    """Start a SuperLink and `num_clients` SuperNodes with new certificates and keys, and stop them at the end.

    Args:
        folder: for certificates, keys and logs; the keys are useless afterwards.
        tls: encrypt connections and let nodes verify the server.
        auth: accept only nodes with registered keys; needs `tls`.
        data: a data set for each node, in the order of partitions.

    Raises:
        FlowerRunError: a program did not start or was rejected.
        ValueError: authentication without TLS, or fewer or more data sets than clients.
    """
    if auth and not tls:
        raise ValueError("auth=True needs tls=True: Flower authenticates nodes on encrypted connections only")
    if data and len(data) != num_clients:
        raise ValueError(f"{len(data)} data folders for num-clients={num_clients}: give one for each client, or none")
    if missing := [str(path) for path in data if not Path(path).is_dir()]:
        raise ValueError(f"no data set at {missing[0]}: give the folder of each node's data set")
    files = credentials.make_server(folder / "server") if tls else None
    keys = [credentials.make_node_key(folder / "keys", f"node_{k}") for k in range(num_clients)] if auth else []
    options = ["--enable-supernode-auth"] if auth else []
    with ExitStack() as last, superlink.local_superlink(folder, *options, files=files) as link:
        deployment = Deployment(link, folder, [Path(path).resolve() for path in data], keys, num_clients)
        last.callback(deployment.kill_nodes)  # after the SuperLink: an interrupted run must not see its clients fail
        for k in range(num_clients):  # the next is registered while this one starts
            if auth:
                link.ask("supernode", "register", str(keys[k].public), CONNECTION)
            deployment.launch_node(k)
        for k in range(num_clients):
            deployment.wait_for_node(k)
        yield deployment
        deployment.kill_nodes()  # before the SuperLink, which would wait for their connections to end


def run_deployed(
    config: Config, *, tls: bool = True, auth: bool = True, data: Sequence[Path] = (), timeout_s: float = 24 * 3600.0,
    say: Callable[[str], None] = print_line,
) -> Path:  # fmt: skip
    """Run a federation on a temporary deployment and return its run folder.

    Args:
        data: a data set for each client; empty: each client uses its partition of ``config.data``.
        say: called with each line of progress.

    Raises:
        FlowerRunError: the run failed or timed out.
        ValueError: unusable settings.
    """
    config = absolute(check(replace(config, num_threads=config.num_threads or 1)))
    before = run_folder.run_folders(config)
    guard.clear(HOME)
    with tempfile.TemporaryDirectory(prefix=HOME) as name:
        folder = Path(name)
        with running_deployment(folder, config.num_clients, tls=tls, auth=auth, data=data) as deployment:
            say(f"{config.num_clients} SuperNodes joined the SuperLink at 127.0.0.1:{deployment.link.port}")
            deployment.run(config, timeout_s, progress_reporter(config, before, say))
    return run_folder.own_run(config, before)


def progress_reporter(config: Config, before: set[Path], say: Callable[[str], None]) -> Callable[[], None]:
    """Return a function that reports the events logged since its last call."""
    seen = {json.dumps(event) for event in _events(config, before)}  # events of a resumed run

    def report() -> None:
        for event in _events(config, before):
            if (line := json.dumps(event)) in seen:
                continue
            seen.add(line)
            values = {key: event["values"][key] for key in REPORTED if event["values"].get(key) is not None}
            text = ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in values.items())
            if text and event["kind"] != "held-out":  # `evaluate` reports their averages
                say(f"round {event['round']}, {event['who']}, {event['kind']}: {text}")

    return report


def _events(config: Config, before: set[Path]) -> list[dict[str, Any]]:
    root = run_folder.own_run(config, before)
    return run_folder.read_events(root) if root and (root / run_folder.METRICS_FILE).is_file() else []


def _says(log: Path, text: str) -> bool:
    return text in log.read_text(errors="replace")
