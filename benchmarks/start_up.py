"""Wall time of a small federation on Flower's engines: processes forked from one that has imported the libraries,
against processes that import them.

Both sides run the same app and end with the same model.

    python benchmarks/start_up.py --profile tiny
"""

import tempfile
from argparse import Namespace
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from unittest import mock

from fedvla_lib.config import Config
from fedvla_lib.engines import deployment, simulation, superlink
from fedvla_lib.federation import checkpoint
from fedvla_lib.policy.parameters import digest
from report import laptop, options, recording, report, start, timed

ENGINES = {"simulation": simulation.run_simulation, "deployment": deployment.run_deployed}


def main() -> None:
    """Measure and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=list(ENGINES), help="engines")
    chosen = parser.parse_args()
    config = replace(laptop(chosen.profile), eval_rollouts=0)
    recording(config)
    report("start_up", [compared(engine, config, chosen) for engine in chosen.engines], chosen.out)


def compared(engine: str, config: Config, chosen: Namespace) -> dict[str, object]:
    """Run both sides in turn; the fastest run of each counts, since other load only adds."""
    forked, imported = zip(*(measure(engine, config) for _ in range(chosen.repeats)), strict=True)
    return {
        "engine": engine,
        "clients": config.num_clients,
        "rounds": config.num_server_rounds,
        "forked [s]": min(forked),
        "imported [s]": min(imported),
        "ratio": min(imported) / min(forked),
    }


def measure(engine: str, config: Config) -> tuple[float, float]:
    """Return the seconds of a federation with forked processes and of one whose processes import everything."""
    forked_s, forked = run(engine, config)
    with mock.patch.object(superlink, "warm_start", lambda environment, log: nullcontext(environment)):
        imported_s, imported = run(engine, config)
    if forked != imported:
        raise ValueError(f"{engine}: the two sides end with different models")
    return forked_s, imported_s


def run(engine: str, config: Config) -> tuple[float, str]:
    """Run a federation; return its wall time in seconds and the SHA-256 of its last global arrays."""
    with tempfile.TemporaryDirectory() as out:
        seconds = timed(lambda: ENGINES[engine](replace(config, out=out)))
        (folder,) = Path(out).iterdir()
        return seconds, digest(checkpoint.load(folder).arrays)


if __name__ == "__main__":
    start(main)
