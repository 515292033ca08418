"""The app on Flower's simulation runtime: Ray workers of this machine."""

import tempfile
from dataclasses import replace
from pathlib import Path

from fedvla_lib.config import Config, absolute, check
from fedvla_lib.engines.app_bundle import stage_app, write_settings
from fedvla_lib.engines.superlink import SuperLink, local_superlink, require_completed
from fedvla_lib.run_folder import own_run, run_folders

# Ray 2.55 gives its server and its raylet 30 s each to come up, and each of the raylet's helpers 15 s. All of that is
# fixed in its code; a busy machine misses it, seldom twice.
RUNTIME_TRIES = 3
NOT_STARTED = "Simulation Runtime crashed"  # what Flower says if Ray did not come up, before any client was asked


def run_simulation(
    config: Config, *, cpus_per_client: int = 1, gpus_per_client: float = 0.0, timeout_s: float = 24 * 3600.0
) -> Path:
    """Run a federation on Flower's simulation runtime (Ray workers) and return its run folder.

    Raises:
        FlowerRunError: the run failed, or did not finish in time.
        ValueError: unusable settings.
    """
    config = check(replace(absolute(config), num_threads=config.num_threads or cpus_per_client))
    before = run_folders(config)
    resources = f"client-resources-num-cpus={cpus_per_client} client-resources-num-gpus={gpus_per_client}"
    with tempfile.TemporaryDirectory(prefix="fedvla-flower-") as folder:
        app, settings = stage_app(Path(folder)), write_settings(Path(folder), config)
        with local_superlink(Path(folder), "--simulation") as link:
            federation = f"num-supernodes={config.num_clients} {resources}"
            options = ["--federation-config", federation, "--run-config", str(settings)]
            require_completed(link, _submit(link, app, options, timeout_s))
    return own_run(config, before)


def _submit(link: SuperLink, app: Path, options: list[str], timeout_s: float) -> str:
    """Run the app, again if Flower's runtime did not come up, and return the id of the last run."""
    for _ in range(RUNTIME_TRIES):
        run_id = link.submit(app, *options, timeout_s=timeout_s)
        if NOT_STARTED not in link.log.read_text(errors="replace"):
            break
    return run_id
