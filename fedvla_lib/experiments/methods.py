"""The four ways of training that the book compares, on the same data and from the same start.

``base`` is the start itself; ``local-only`` is one client on its own episodes; ``federated`` is Flower's FedAvg over
all clients; ``centralized`` pools the clients' training episodes. From the same settings, *centralized* is given the
steps that all clients of the federation do together, and *local-only* its share of them, which is fewer: total over
number of clients. What a model then took is counted while it trains, see `counted`. Results are kept in the cache and
found again by settings and by the code that decides them, so that a change of either trains anew.
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from filelock import FileLock

from fedvla_lib import files, provenance, run_folder
from fedvla_lib.config import Config
from fedvla_lib.data import normalisation
from fedvla_lib.engines import inline
from fedvla_lib.federation.client import Client, open_client, open_pooled
from fedvla_lib.federation.nodes import draw_size
from fedvla_lib.files import cache_dir
from fedvla_lib.policy import model, nano, prefix_cache
from fedvla_lib.policy.training import TrainResult, local_train
from fedvla_lib.provenance import code_digest

CENTRALIZED = "centralized"
STEPS_FILE = "steps.json"  # beside the weights of a model in the cache: the steps that it took, counted


def total_steps(config: Config) -> int:
    """Gradient steps that a federated run asks of all clients together: what the centralized method may spend."""
    return steps_in_a_row(config) * draw_size(config.fraction_train, config.num_clients)


def steps_per_client(config: Config) -> int:
    """Gradient steps that a federated run asks of one client, on average where a round draws some of them."""
    return max(1, total_steps(config) // config.num_clients)


def steps_in_a_row(config: Config) -> int:
    """Gradient steps that a federated run asks for between start and last global model, one after the other."""
    return config.num_server_rounds * config.local_steps


def federated(config: Config, progress: bool = True) -> Path:
    """Return the folder of a completed run with these settings, running it in this process if there is none."""
    out = cache_dir() / "runs" / _key(config)
    with _alone(out):
        for folder in sorted(out.glob("*/")):
            if run_folder.read_stamp(folder)["status"] == "completed":
                return folder
        return inline.run_inline(replace(config, out=str(out)), progress=progress)


def federated_policy(config: Config) -> model.Bundle:
    """Return the global model after the last round of the federated run."""
    last = federated(config) / "global_model" / f"round_{config.num_server_rounds}"
    return model.load_policy(replace(config, base=str(last)))


def base(config: Config) -> model.Bundle:
    """Return the model every method starts from, with the normalisation of the pooled training episodes."""
    pooled = normalisation.common_statistics(config, open_pooled(config).statistics())
    return model.load_policy(config, pooled)


def centralized(config: Config, progress: bool = True) -> model.Bundle:
    """Train on all clients' training episodes for the steps that all clients do together."""
    whole = open_pooled(config)
    return _kept(config, CENTRALIZED, lambda: _train(config, whole, total_steps(config), progress))


def local_only(config: Config, partition_id: int, progress: bool = True) -> model.Bundle:
    """Train on one client's episodes alone, for as many steps as the federation asks of it on average.

    The normalisation is the pooled one, as in the federation: what differs is only whose episodes are seen.
    """
    client = open_client(config, partition_id)
    steps = steps_per_client(config)
    return _kept(config, _alone_name(partition_id), lambda: _train(config, client, steps, progress))


def counted(config: Config, partition_id: int | None = None) -> dict[str, int]:
    """Return the gradient steps that a model in the cache took, counted while it trained: ``in_all``, ``in_a_row``.

    The two are equal here. They differ in a federation, whose clients train side by side: `run_folder.counted_steps`.

    Args:
        partition_id: the client that trained alone; None for the centralized model.

    Raises:
        ValueError: there is no such model with these settings yet.
    """
    name = CENTRALIZED if partition_id is None else _alone_name(partition_id)
    file = _place(config, name) / STEPS_FILE
    if not file.is_file():
        raise ValueError(f"{name} has not been trained with these settings: train it before asking for its steps")
    return json.loads(file.read_text())


def _alone_name(partition_id: int) -> str:
    return f"local-only-{partition_id}"


def _train(config: Config, client: Client, steps: int, progress: bool) -> tuple[model.Bundle, TrainResult]:
    bundle = base(config)
    return bundle, train_alone(bundle, client, steps=steps, progress=progress)


def train_alone(bundle: model.Bundle, client: Client, *, steps: int, **how: Any) -> TrainResult:
    """Train a policy in place on one client's episodes; `how` goes to `local_train`."""
    batches = prefix_cache.with_cached_prefixes(bundle, client.batches())
    return local_train(bundle, batches, client.config, steps=steps, **how)


def _kept(config: Config, name: str, train: Callable[[], tuple[model.Bundle, TrainResult]]) -> model.Bundle:
    """Load the method's model from the cache, or train and keep it."""
    folder = _place(config, name)
    with _alone(folder):
        if not folder.exists():
            _keep(folder, *train())
    return model.load_policy(replace(config, base=str(folder)))


def _keep(folder: Path, bundle: model.Bundle, result: TrainResult) -> None:
    """Write the model and, beside it, the steps that it took."""
    with files.new_folder(folder) as draft:
        model.write_policy(bundle, draft)
        files.write_json(draft / STEPS_FILE, {"in_all": result.steps, "in_a_row": result.steps})


def _place(config: Config, name: str) -> Path:
    return cache_dir() / "methods" / f"{name}-{_key(config)}"


def _alone(kept: Path) -> FileLock:
    """A lock beside what is kept: of two chapters that want the same model, the second waits and trains nothing."""
    kept.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(kept.with_name(f"{kept.name}.lock"))


def trained_by() -> str:
    """Return the digest of the code that decides what a method's model learns."""
    return code_digest(federated)


def _key(config: Config) -> str:
    """Identify settings, start and code: what older code or another base brought must not pass for a result of this."""
    whole = "|".join([provenance.config_hash(config), nano.base_digest(config.base), trained_by()])
    return hashlib.sha256(whole.encode()).hexdigest()[:16]
