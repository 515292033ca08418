"""The four ways of training that the book compares, on the same data, from the same start, at equal gradient steps.

``base`` is the start itself; ``local-only`` is one client on its own episodes; ``federated`` is Flower's FedAvg over
all clients; ``centralized`` pools the clients' training episodes. Results are kept in the cache and found again by
settings and by the code that decides them, so that a change of either trains anew.
"""

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from filelock import FileLock

from fedvla_lib import clients, data, engine, model, prefix, run_folder, wire
from fedvla_lib.clients import Client, Share
from fedvla_lib.config import Config, cache_dir, code_digest
from fedvla_lib.roster import draw_size
from fedvla_lib.train import local_train

# Code that decides what an arm learns; what only draws, compares or starts things may change without training anew.
TRAINED_BY = (
    *data.RECORDED_BY, "source", "store", "data", "nano", "model", "prefix", "train", "config", "partition", "params",
    "corrections", "quantise", "lora", "clients", "client_app", "server_app", "grid", "strategies", "roster", "wire",
    "evaluate", "engine", "arms",
)  # fmt: skip


def total_steps(config: Config) -> int:
    """Gradient steps that all clients together do in a federated run: what the centralized arm may spend."""
    return steps_in_a_row(config) * draw_size(config.fraction_train, config.num_clients)


def steps_per_client(config: Config) -> int:
    """Gradient steps that one client does in a federated run, on average where a round draws some of them."""
    return max(1, total_steps(config) // config.num_clients)


def steps_in_a_row(config: Config) -> int:
    """Gradient steps between the start and the last global model of a federated run, one after the other."""
    return config.num_server_rounds * config.local_steps


def federated(config: Config, progress: bool = True) -> Path:
    """Return the folder of a completed run with these settings, running it in this process if there is none."""
    out = cache_dir() / "runs" / _key(config)
    with _alone(out):
        for folder in sorted(out.glob("*/")):
            if run_folder.read_stamp(folder)["status"] == "completed":
                return folder
        return engine.run_inline(replace(config, out=str(out)), progress=progress)


def federated_policy(config: Config) -> model.Bundle:
    """Return the global model after the last round of the federated run."""
    last = federated(config) / "global_model" / f"round_{config.num_server_rounds}"
    return model.load_policy(replace(config, base=str(last)))


def base(config: Config) -> model.Bundle:
    """Return the model every arm starts from, with the normalisation of the pooled training episodes."""
    return clients.load_policy(config, _pooled_stats(config))


def centralized(config: Config, progress: bool = True) -> model.Bundle:
    """Train on all clients' training episodes for the steps that all clients do together."""
    whole = _everything(config)
    return _kept(config, "centralized", lambda: _train(config, whole, total_steps(config), progress))


def local_only(config: Config, partition_id: int, progress: bool = True) -> model.Bundle:
    """Train on one client's episodes alone, for as many steps as it does in the federation.

    The normalisation is the pooled one, as in the federation: what differs is only whose episodes are seen.
    """
    client = clients.open_client(config, partition_id)
    steps = steps_per_client(config)
    return _kept(config, f"local-only-{partition_id}", lambda: _train(config, client, steps, progress))


def _train(config: Config, client: Client, steps: int, progress: bool) -> model.Bundle:
    bundle = base(config)
    local_train(bundle, prefix.stored(bundle, client.batches()), config, steps=steps, progress=progress)
    return bundle


def _kept(config: Config, name: str, train: Callable[[], model.Bundle]) -> model.Bundle:
    """Load the arm's model from the cache, or train and keep it."""
    folder = cache_dir() / "arms" / f"{name}-{_key(config)}"
    with _alone(folder):
        if not folder.exists():
            model.save_policy(train(), folder)
    return model.load_policy(replace(config, base=str(folder)))


def _alone(kept: Path) -> FileLock:
    """A lock beside what is kept: of two chapters that want the same model, the second waits and trains nothing."""
    kept.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(kept.with_name(f"{kept.name}.lock"))


def _everything(config: Config) -> Client:
    """One client with every training episode and client 0's random stream: of one client, all arms learn the same."""
    store = clients.open_frames(config)
    train_ids, val_ids = data.split(store, config.val_fraction, config.seed)
    return Client(config, 0, store, Share(train_ids, val_ids))


def _pooled_stats(config: Config) -> str:
    """The statistics a federation pools, computed from all training episodes at once: they are equal."""
    return wire.pack_stats(clients.common_statistics(config, _everything(config).statistics()))


def _key(config: Config) -> str:
    """Identify settings, start and code: what older code or another base brought must not pass for a result of this."""
    whole = "|".join([run_folder.config_hash(config), model.base_digest(config.base), code_digest(*TRAINED_BY)])
    return hashlib.sha256(whole.encode()).hexdigest()[:16]
