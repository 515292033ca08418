"""The methods that the book compares, on the same data and from the same base.

``base`` is the starting model; ``local-only`` trains one client on its own episodes; ``federated`` is a federated run
over all clients; ``centralized`` trains on all clients' episodes. Unless `Config.alone_steps` says otherwise,
*centralized* gets the total gradient steps of the federation, *local-only* that total over the number of clients.
Results are cached by settings and by the digest of the code that determines them, so changing either means retraining.
"""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

from filelock import FileLock

from fedvla_lib import files, provenance, run_folder
from fedvla_lib.config import Config, sample_size
from fedvla_lib.data import normalisation
from fedvla_lib.engines import inline
from fedvla_lib.federation.client import Client, open_client, open_pooled
from fedvla_lib.files import cache_dir, read_json
from fedvla_lib.policy import model, nano, prefix_cache
from fedvla_lib.policy.training import TrainResult, local_train
from fedvla_lib.provenance import code_digest
from fedvla_lib.workers import default_jobs

STEPS_FILE = "steps.json"  # next to a cached model's weights: its gradient steps as counted while training


def total_steps(config: Config) -> int:
    """Planned gradient steps of a federated run, summed over clients; the budget of centralized training."""
    return steps_in_a_row(config) * sample_size(config.fraction_train, config.num_clients)


def steps_per_client(config: Config) -> int:
    """Planned gradient steps per client of a federated run: the average if rounds sample clients."""
    return max(1, total_steps(config) // config.num_clients)


def steps_in_a_row(config: Config) -> int:
    """Planned sequential gradient steps between base and last global model of a federated run."""
    return config.num_server_rounds * config.local_steps


def federated(config: Config, progress: bool = True) -> Path:
    """Return the run folder of a completed run with these settings; run it in this process if there is none."""
    out = cache_dir() / "runs" / _key(config)
    with _lock(out):
        for folder in sorted(out.glob("*/")):
            if run_folder.read_stamp(folder)["status"] == "completed":
                return folder
        config = replace(config, out=str(out), keep_last=0, keep_every=0)  # others may want an earlier model of it
        return inline.run_inline(config, progress=progress, jobs=default_jobs(config.device))


def federated_policy(config: Config) -> model.Bundle:
    """Return the global model after the last round of the federated run."""
    last = federated(config) / "global_model" / f"round_{config.num_server_rounds}"
    return model.load_policy(replace(config, base=str(last)))


def base(config: Config) -> model.Bundle:
    """Return the model that every method starts from, with the statistics of the pooled training episodes."""
    return model.load_policy(config, normalisation.common_statistics(config, open_pooled(config).statistics()))


def centralized(config: Config, progress: bool = True) -> model.Bundle:
    """Train on all clients' training episodes for `total_steps`, or load the cached model."""
    return _trained_alone(config, None, progress)


def local_only(config: Config, partition_id: int, progress: bool = True) -> model.Bundle:
    """Train on one client's episodes for `steps_per_client`, or load the cached model.

    Normalisation uses the pooled statistics, as in the federation.
    """
    return _trained_alone(config, partition_id, progress)


def counted(config: Config, partition_id: int | None = None) -> dict[str, int]:
    """Return the gradient steps of a cached model as counted while training: ``in_all`` and ``in_a_row``.

    Both are equal here; they differ for federated runs, see `run_folder.counted_steps`.

    Args:
        partition_id: client of a local-only model; None for the centralized model.

    Raises:
        ValueError: no model with these settings is cached.
    """
    file = _folder(config, partition_id) / STEPS_FILE
    if not file.is_file():
        name = _name(partition_id)
        raise ValueError(f"{name} has not been trained with these settings: train it before asking for its steps")
    return read_json(file, dict[str, int])


def train_alone(bundle: model.Bundle, client: Client, *, steps: int, **options: Any) -> TrainResult:
    """Train a policy in place on one client's episodes; `options` are passed to `local_train`."""
    batches = prefix_cache.with_cached_prefixes(bundle, client.batches())
    return local_train(bundle, batches, client.config, steps=steps, **options)


def _trained_alone(config: Config, partition_id: int | None, progress: bool) -> model.Bundle:
    """Load the model of a client, or of all clients' data, from the cache, or train and cache it."""
    folder = _folder(config, partition_id)
    with _lock(folder):
        if not folder.exists():
            pooled = partition_id is None
            client = open_pooled(config) if pooled else open_client(config, partition_id)
            steps = config.alone_steps or (total_steps(config) if pooled else steps_per_client(config))
            bundle = base(config)
            result = train_alone(bundle, client, steps=steps, progress=progress)
            with files.new_folder(folder) as draft:
                model.write_policy(bundle, draft)
                files.write_json(draft / STEPS_FILE, {"in_all": result.steps, "in_a_row": result.steps})
    return model.load_policy(replace(config, base=str(folder)))


def _name(partition_id: int | None) -> str:
    return "centralized" if partition_id is None else f"local-only-{partition_id}"


def _folder(config: Config, partition_id: int | None) -> Path:
    return cache_dir() / "methods" / f"{_name(partition_id)}-{_key(config)}"


def _lock(cached: Path) -> FileLock:
    """If two processes want the same model, the second waits and then loads it."""
    cached.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(cached.with_name(f"{cached.name}.lock"))


def trained_by() -> str:
    """Return the digest of the code that determines what a method's model learns."""
    return code_digest(federated)


def _key(config: Config) -> str:
    """Cache key of settings, base weights and code, so that results of older code or another base are not reused."""
    parts = [provenance.config_hash(config), nano.base_digest(config.base), trained_by()]
    return hashlib.sha256("|".join(parts).encode()).hexdigest()[:16]
