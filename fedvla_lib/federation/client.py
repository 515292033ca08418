"""A client without Flower: what it holds and what it does in a round. `client_app` is a thin shell around this module.

Data set, split and partition follow from the run's settings, so that all clients agree on them without communication;
each client uses only its own episodes.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fedvla_lib.config import Config, split_names
from fedvla_lib.data import frame_store, splits
from fedvla_lib.data.batches import Batches
from fedvla_lib.data.normalisation import Stats, episode_stats, pack_stats, unpack_stats
from fedvla_lib.data.recordings import open_frames
from fedvla_lib.data.splits import Share, labs_of, shares, tasks_of
from fedvla_lib.evaluation.measure import measure
from fedvla_lib.evaluation.rollouts import FIRST_SEED, evaluate, rollout_seeds, simulates
from fedvla_lib.policy import model, prefix_cache, training
from fedvla_lib.policy.actor import PolicyActor
from fedvla_lib.policy.model import Bundle
from fedvla_lib.policy.parameters import Arrays
from fedvla_lib.policy.training import Correction

CLIENT_SEEDS = 1_000  # rollout seeds reserved for each client


@dataclass(frozen=True)
class Loaders:
    """How frames are opened, divided among clients, and a policy is built; the engines pass cached functions.

    Clients may share one policy: each overwrites all trainable arrays, and nothing else changes.
    """

    open_frames: Callable[[Config], frame_store.FrameStore]
    load_policy: Callable[[Config, Stats], Bundle]  # settings, statistics to normalise with
    shares: Callable[[frame_store.FrameStore, Config], list[Share]] = shares


LOADERS = Loaders(open_frames, model.load_policy)


def cached(loaders: Loaders, limit: int | None = None) -> Loaders:
    """Return loaders that open the frames and build the policy once and share them between clients.

    Args:
        limit: maximum number of data sets, and of policies, kept in memory; None keeps all.
    """
    keep = functools.lru_cache(limit)
    # Statistics hold arrays, which are not hashable; their text form is, and it is exact.
    build = keep(lambda config, text: loaders.load_policy(config, unpack_stats(text)))
    frames, shares = keep(loaders.open_frames), keep(loaders.shares)
    return Loaders(frames, lambda config, stats: build(config, pack_stats(stats)), shares)


class WorkerLoaders(Loaders):
    """Cached loaders of a process. Ray sends the app with every message; these are sent by name, so that they stay."""

    def __reduce__(self) -> str:
        """Return the name in this module."""
        return "WORKER_LOADERS"


# One policy: with normalisation=own each client has another.
WORKER_LOADERS = WorkerLoaders(**vars(cached(LOADERS, limit=1)))


@dataclass(frozen=True)
class Client:
    """One client of a run."""

    config: Config
    partition_id: int
    store: frame_store.FrameStore
    share: Share

    @property
    def num_examples(self) -> int:
        """Training frames: the client's weight in the average."""
        return self.batches().num_examples

    @property
    def tasks(self) -> list[str]:
        """What its training episodes show, sorted; announced to the server."""
        episodes = self.store.episodes
        return sorted(set(episodes.task[episodes.episode_id.isin(self.share.train_ids)]))

    def statistics(self) -> Stats:
        """Mean, standard deviation, range and count of state and action over the client's training episodes."""
        return episode_stats(self.store, self.share.train_ids)

    def train(
        self, bundle: Bundle, round_number: int, correction: Correction | None = None, moments: Arrays | None = None,
        second_moments: Arrays | None = None,
    ) -> training.TrainResult:  # fmt: skip
        """Train for one round, continuing the data order and learning-rate schedule of the round before.

        Args:
            correction: changes gradients, as the strategy asks.
            moments: optimiser state after this client's last round; None starts fresh.
            second_moments: the server's, for a local optimiser that shares them.
        """
        config, steps = self.config, self.config.local_steps
        before, length = (round_number - 1) * steps, config.num_server_rounds * steps
        return training.local_train(
            bundle, prefix_cache.with_cached_prefixes(bundle, self.batches()), config, steps=steps,
            start=training.Start(before, length, moments, second_moments or {}),
            objective=training.Objective(correction=correction), progress=False,
        )  # fmt: skip

    def batches(self) -> Batches:
        """Training batches; the random stream is the client's own."""
        config, seed = self.config, client_seed(self.config.seed, self.partition_id)
        return Batches(
            self.store, self.share.train_ids, config.chunk_size, config.batch_size, seed=seed, augment=config.augment
        )

    def validate(self, bundle: Bundle) -> tuple[int, dict[str, float]]:
        """Return the number of held-out frames and the averages over them; 0 and {} without held-out episodes."""
        found = measure(bundle, self.store, self.config, episode_ids=self.share.val_ids)
        return found.num_examples, found.averages

    def roll_out(self, bundle: Bundle, videos_dir: Path) -> list[dict[str, Any]]:
        """Roll the policy out on the client's tasks, in turn, with videos in `videos_dir`; return a row per rollout.

        Seeds and the first task differ between clients, so that they do not all show the same scene.
        """
        held = tasks_of(self.store, self.share.train_ids)
        tasks = held if simulates(self.config) else []
        labs = labs_of(self.store, self.share.train_ids, self.config)
        seeds = rollout_seeds(self.config.client_rollouts, FIRST_SEED + CLIENT_SEEDS * (self.partition_id + 1))
        actor = PolicyActor(bundle, self.config.seed)
        rows = []
        for turn, seed in enumerate(seeds if tasks else []):
            task, lab = tasks[(self.partition_id + turn) % len(tasks)], labs[turn % len(labs)]
            rows += evaluate(
                actor, [task], [seed], image_size=self.config.image_size, labs=[lab], videos_dir=videos_dir,
                progress=False,
            )  # fmt: skip
        return rows


def open_client(config: Config, partition_id: int, loaders: Loaders = LOADERS, own_data: str = "") -> Client:
    """Return client `partition_id` with its partition of the run's data set, or with all of its own data set.

    Args:
        own_data: folder or hub id of the client's own data set; empty for the one in ``config.client_data``, or its
            partition of ``config.data``.

    Raises:
        ValueError: there is no such partition; the message says what to change.
    """
    if not 0 <= partition_id < config.num_clients:
        raise ValueError(
            f"partition-id={partition_id} is not one of num-clients={config.num_clients} partitions (0 to "
            f"{config.num_clients - 1}): start as many SuperNodes as num-clients says"
        )
    own_data = own_data or (split_names(config.client_data)[partition_id] if config.client_data else "")
    if own_data:
        return open_pooled(replace(config, data=own_data), loaders, partition_id)
    store = loaders.open_frames(config)
    return Client(config, partition_id, store, loaders.shares(store, config)[partition_id])


def open_pooled(config: Config, loaders: Loaders = LOADERS, partition_id: int = 0) -> Client:
    """Return one client that holds all training episodes of a data set: centralized training, or a lab with its data.

    Its random stream is that of client `partition_id`: with one client, all methods learn the same.
    """
    store = loaders.open_frames(config)
    return Client(config, partition_id, store, Share(*splits.split(store, config.val_fraction, config.seed)))


def client_seed(seed: int, partition_id: int) -> int:
    """Return the seed of a client's random stream, different for each client and run."""
    return int(np.random.SeedSequence([seed, partition_id]).generate_state(1)[0])
