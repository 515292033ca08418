"""A deployment on this machine: a SuperLink and one SuperNode a client, each a process as on a host of its own.

What differs from several hosts is the address and who starts the processes; certificates, keys, node settings and the
app are the same. Everything that is started is stopped at the end, also on Ctrl-C and when the run fails.
"""

import json
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from fedvla_lib import run_folder
from fedvla_lib.config import Config, absolute, check
from fedvla_lib.engines import app_bundle, credentials, processes, superlink
from fedvla_lib.engines.processes import FlowerRunError
from fedvla_lib.engines.superlink import CONNECTION, SuperLink

CONNECTED = "SuperNode ID:"  # what a SuperNode logs once the SuperLink has let it in
UNTRUSTED = "CERTIFICATE_VERIFY_FAILED"  # what it logs at each try if the SuperLink is none that it trusts
SHOWN = ("loss", "success_rate", "num_examples", "reason", "detail")


@dataclass
class Deployment:
    """A SuperLink that is up, and its SuperNodes: one a client, by partition."""

    link: SuperLink
    folder: Path
    data: Sequence[Path]  # of each node; none: what the settings of the run say
    keys: list[credentials.NodeKey]  # of each node; none without authentication
    num_clients: int
    nodes: dict[int, subprocess.Popen] = field(default_factory=dict)

    def log(self, partition_id: int) -> Path:
        """Where a node's output goes."""
        return self.folder / f"node_{partition_id}" / "supernode.log"

    def start_node(self, partition_id: int) -> None:
        """Start the SuperNode of a client and wait until the SuperLink has let it in.

        A SuperLink turns a known key away until it has noticed that the node which used it before is gone, so for a
        node that was in before this tries again, as a host's service manager would.

        Raises:
            FlowerRunError: it was refused, refuses the SuperLink, or did not get through; with its own words.
        """
        was_in = _count(self.log(partition_id)) > 0
        deadline = time.monotonic() + processes.STARTUP_S
        while True:
            try:
                return self._try_node(partition_id)
            except FlowerRunError:
                if not was_in or time.monotonic() > deadline:
                    raise
                time.sleep(superlink.POLL_S)

    def _try_node(self, partition_id: int) -> None:
        log = self.log(partition_id)
        log.parent.mkdir(exist_ok=True)
        before, distrusted = _count(log), _count(log, UNTRUSTED)
        node = processes.start(self._command(partition_id), superlink.flower_environment(log.parent), log)
        self.nodes[partition_id] = node
        who = f"the SuperNode of client {partition_id}"
        processes.wait_until(lambda: _count(log) > before or _count(log, UNTRUSTED) > distrusted, node, log, who)
        if _count(log) == before:  # it would try again for ever
            raise FlowerRunError(f"{who} does not trust the SuperLink; {processes.reason(log)}")

    def kill_node(self, partition_id: int) -> None:
        """End a SuperNode without warning, as a power cut does, and what it had started."""
        node = self.nodes.pop(partition_id)
        processes.stop(node, (signal.SIGKILL,))

    def _command(self, partition_id: int) -> list[str]:
        told = f"partition-id={partition_id} num-partitions={self.num_clients}"
        if self.data:
            told += f" data={json.dumps(str(self.data[partition_id]))}"
        trust = ["--root-certificates", str(self.link.files.authority)] if self.link.files else ["--insecure"]
        if self.keys:
            trust += ["--auth-supernode-private-key", str(self.keys[partition_id].private)]
        address, own_port = f"127.0.0.1:{self.link.port}", str(processes.free_port())
        return ["flower-supernode", *trust, "--superlink", address, "--node-config", told, "--port", own_port]


@contextmanager
def running_deployment(
    folder: Path, num_clients: int, *, tls: bool = True, auth: bool = True, data: Sequence[Path] = ()
) -> Iterator[Deployment]:
    """Start a SuperLink and `num_clients` SuperNodes with new certificates and keys, and stop them at the end.

    Args:
        folder: for certificates, keys and logs; the keys are worth nothing afterwards.
        tls: encrypt, and let nodes check who the server is.
        auth: let only nodes in whose keys the server knows; needs `tls`.
        data: a data set for each node, in the order of partitions.

    Raises:
        FlowerRunError: a program did not start or was refused.
        ValueError: authentication without TLS, or another number of data sets than clients.
    """
    if auth and not tls:
        raise ValueError("auth=True needs tls=True: Flower authenticates nodes on encrypted connections only")
    if data and len(data) != num_clients:
        raise ValueError(f"{len(data)} data folders for num-clients={num_clients}: give one for each client, or none")
    files = credentials.make_server(folder / "server") if tls else None
    keys = [credentials.make_node_key(folder / "keys", f"node_{k}") for k in range(num_clients)] if auth else []
    options = ["--enable-supernode-auth"] if auth else []
    with superlink.local_superlink(folder, *options, files=files) as link:
        here = Deployment(link, folder, [Path(path).resolve() for path in data], keys, num_clients)
        try:
            for key in keys:
                link.ask("supernode", "register", str(key.public), CONNECTION)
            for k in range(num_clients):
                here.start_node(k)
            yield here
        finally:
            for node in here.nodes.values():
                processes.stop(node)


def say_at_once(line: str) -> None:
    """Print a line at once, also into a pipe."""
    print(line, flush=True)


def run_deployed(
    config: Config,
    *,
    tls: bool = True,
    auth: bool = True,
    data: Sequence[Path] = (),
    timeout_s: float = 24 * 3600.0,
    say: Callable[[str], None] = say_at_once,
) -> Path:
    """Run a federation on a deployment made for the occasion, and return its run folder.

    Args:
        data: a data set for each client; without, each takes its part of ``config.data``.
        say: told what the run measures as it goes.

    Raises:
        FlowerRunError: the run failed, or did not finish in time.
        ValueError: unusable settings.
    """
    config = absolute(check(replace(config, num_threads=config.num_threads or 1)))
    before = run_folder.run_folders(config)
    with tempfile.TemporaryDirectory(prefix="fedvla-deploy-") as name:
        folder = Path(name)
        with running_deployment(folder, config.num_clients, tls=tls, auth=auth, data=data) as here:
            say(f"{config.num_clients} SuperNodes joined the SuperLink at 127.0.0.1:{here.link.port}")
            submit(here, config, timeout_s, progress_reporter(config, before, say))
    return run_folder.own_run(config, before)


def submit(here: Deployment, config: Config, timeout_s: float, watch: Callable[[], None] = lambda: None) -> None:
    """Run the app on a deployment to its end.

    Raises:
        FlowerRunError: the run failed, or did not finish in time.
    """
    app, settings = app_bundle.stage_app(here.folder), app_bundle.write_settings(here.folder, config)
    run_id = here.link.submit(app, "--run-config", str(settings), timeout_s=timeout_s, watch=watch)
    superlink.require_completed(here.link, run_id)


def progress_reporter(config: Config, before: set[Path], say: Callable[[str], None]) -> Callable[[], None]:
    """Return a function that says what the run has measured since it was last called."""
    seen = {json.dumps(event) for event in _events(config, before)}  # by an earlier process, of a run to be resumed

    def tell() -> None:
        for event in _events(config, before):
            if (written := json.dumps(event)) in seen:
                continue
            seen.add(written)
            values = {key: event["values"][key] for key in SHOWN if event["values"].get(key) is not None}
            shown = ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in values.items())
            if shown and event["kind"] != "held-out":  # `evaluate` has their averages
                say(f"round {event['round']}, {event['who']}, {event['kind']}: {shown}")

    return tell


def _events(config: Config, before: set[Path]) -> list[dict[str, Any]]:
    root = run_folder.own_run(config, before)
    return run_folder.read_events(root / "metrics.jsonl") if root and (root / "metrics.jsonl").is_file() else []


def _count(log: Path, words: str = CONNECTED) -> int:
    return log.read_text(errors="replace").count(words) if log.exists() else 0
