"""Run the app on Flower's simulation runtime, with Ray workers on this machine."""

import tempfile
from dataclasses import replace
from pathlib import Path

from fedvla_lib.config import Config, absolute, check
from fedvla_lib.engines import app_bundle, guard
from fedvla_lib.engines.superlink import local_superlink, require_completed
from fedvla_lib.run_folder import own_run, run_folders

HOME = "fedvla-flower-"  # begins the names of temporary folders
# Ray 2.55 has hard-coded start-up timeouts (30 s for its server and raylet, 15 s for the raylet's helpers). A busy
# machine may exceed them, but rarely twice in a row.
RUNTIME_TRIES = 3
NOT_STARTED = "Simulation Runtime crashed"  # logged by Flower if Ray did not start, before any client was called


def run_simulation(config: Config, *, timeout_s: float = 24 * 3600.0) -> Path:
    """Run a federation on Flower's simulation runtime (Ray workers) and return its run folder.

    Raises:
        FlowerRunError: the run failed or timed out.
        ValueError: unusable settings.
    """
    config = check(replace(absolute(config), num_threads=config.num_threads or 1))
    before = run_folders(config)
    guard.clear(HOME)
    with tempfile.TemporaryDirectory(prefix=HOME) as folder:
        app = app_bundle.stage_app(Path(folder), config)
        with local_superlink(Path(folder), "--simulation") as link:
            federation = f"num-supernodes={config.num_clients} client-resources-num-cpus=1"
            for _ in range(RUNTIME_TRIES):
                run_id = link.submit(app, "--federation-config", federation, timeout_s=timeout_s)
                if NOT_STARTED not in link.log.read_text(errors="replace"):
                    break
            require_completed(link, run_id)
    return own_run(config, before)
