"""What a client holds and what it does in a round, without Flower: `client_app` is a thin shell around this module.

Data set, split and partition follow from the run's settings, so all clients agree on them without talking; each then
touches only the episodes of its own part.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fedvla_lib import data, model, partition, prefix, train
from fedvla_lib.config import Config, task_names
from fedvla_lib.corrections import Correction
from fedvla_lib.evaluate import FIRST_SEED, evaluate, rollout_seeds
from fedvla_lib.lab import REFERENCE, Lab, labs
from fedvla_lib.params import Arrays
from fedvla_lib.tasks import ALL_TASKS
from fedvla_lib.wire import unpack_stats

VALIDATION_STRIDE = 5  # held-out frames are taken every half second: neighbours are nearly copies
VALIDATION_BATCH = 32  # fixed, so that the noise of a validation does not depend on the settings of training
CLIENT_SEEDS = 1_000  # rollout seeds set aside for each client


@dataclass(frozen=True)
class Share:
    """Episode ids of one client; no two clients share any."""

    train_ids: list[int]
    val_ids: list[int]


@dataclass(frozen=True)
class Tools:
    """How frames are opened and a policy is built. The inline engine passes functions that remember their result.

    Lending one policy to several clients is safe: each overwrites all trainable arrays and nothing else ever changes.
    """

    open_frames: Callable[[Config], data.FrameStore]
    load_policy: Callable[[Config, str], model.Bundle]  # settings, statistics as JSON text


def open_frames(config: Config) -> data.FrameStore:
    """Open the data set that the settings name, recording and decoding it first if need be."""
    return data.open_store(data.resolve(config), image_size=config.image_size)


def load_policy(config: Config, stats_text: str) -> model.Bundle:
    """Build the policy that normalises with the given statistics."""
    return model.load_policy(config, unpack_stats(stats_text))


TOOLS = Tools(open_frames, load_policy)


def common_statistics(config: Config, pooled: model.Stats) -> model.Stats:
    """Return the statistics that all clients are sent: the pooled ones, unless nothing is to be normalised."""
    return data.no_stats() if config.normalisation == "none" else pooled


def judging_statistics(config: Config, common: model.Stats, store: data.FrameStore) -> model.Stats:
    """Return the statistics that the global model is judged with: the common ones, or by mistake the held-out ones."""
    if config.normalisation != "held-out":
        return common
    return data.episode_stats(store, held_out_episodes(store, config))


@dataclass(frozen=True)
class Client:
    """Client `partition_id` of a run."""

    config: Config
    partition_id: int
    store: data.FrameStore
    share: Share

    @property
    def num_examples(self) -> int:
        """Training frames: the client's weight."""
        return num_frames(self.store, self.share.train_ids)

    def statistics(self) -> model.Stats:
        """Mean, standard deviation, range and count of state and action over the client's training episodes."""
        return data.episode_stats(self.store, self.share.train_ids)

    def train(
        self,
        bundle: model.Bundle,
        round_number: int,
        correction: Correction | None = None,
        moments: Arrays | None = None,
    ) -> train.TrainResult:
        """Train for one round; data order and learning rate go on where the round before stopped.

        Args:
            correction: what the strategy adds to gradients.
            moments: the optimiser's state after this client's last round; None starts each round afresh.
        """
        config = self.config
        return train.local_train(
            bundle,
            prefix.stored(bundle, self.batches()),
            config,
            steps=config.local_steps,
            start_step=(round_number - 1) * config.local_steps,
            total_steps=config.num_server_rounds * config.local_steps,
            progress=False,
            correction=correction,
            moments=moments,
        )

    def batches(self) -> data.Batches:
        """Training batches; each client has its own random stream."""
        config, seed = self.config, client_seed(self.config.seed, self.partition_id)
        return data.Batches(
            self.store, self.share.train_ids, config.chunk_size, config.batch_size, seed=seed, augment=config.augment
        )

    def validate(self, bundle: model.Bundle) -> tuple[int, dict[str, float]]:
        """Return the held-out frames measured and the measurements; 0 and none without held-out episodes."""
        return validate(bundle, self.store, self.share.val_ids, self.config)

    def roll_out(self, bundle: model.Bundle, videos_dir: Path) -> list[dict[str, Any]]:
        """Let the policy act on the tasks that the client holds, in turn; videos go to `videos_dir`.

        Seeds and the first task differ from client to client, else all would film the same scene.
        """
        held = tasks_of(self.store, self.share.train_ids)
        own = labs_of(self.store, self.share.train_ids, self.config)
        seeds = rollout_seeds(self.config.client_rollouts, FIRST_SEED + CLIENT_SEEDS * (self.partition_id + 1))
        actor = model.PolicyActor(bundle, self.config.seed)
        rows = []
        for turn, seed in enumerate(seeds if held else []):
            task = held[(self.partition_id + turn) % len(held)]
            where = own[turn % len(own)]
            rows += evaluate(
                actor, [task], [seed], image_size=self.config.image_size, labs=[where], videos_dir=videos_dir,
                progress=False,
            )  # fmt: skip
        return rows


def open_client(config: Config, partition_id: int, tools: Tools = TOOLS, own_data: str = "") -> Client:
    """Return client `partition_id` with its episodes: a part of the run's data set, or all of one that is its own.

    Args:
        own_data: the client's own data set, a folder or hub id; without one it takes its part of ``config.data``.

    Raises:
        ValueError: there is no such partition; the message says what to change.
    """
    if not 0 <= partition_id < config.num_clients:
        raise ValueError(
            f"partition-id={partition_id} is not one of num-clients={config.num_clients} partitions (0 to "
            f"{config.num_clients - 1}): start as many SuperNodes as num-clients says"
        )
    if own_data:
        config = replace(config, data=own_data)
        store = tools.open_frames(config)
        return Client(config, partition_id, store, Share(*data.split(store, config.val_fraction, config.seed)))
    store = tools.open_frames(config)
    return Client(config, partition_id, store, shares(store, config)[partition_id])


def shares(store: data.FrameStore, config: Config) -> list[Share]:
    """Split off held-out episodes, then deal both kinds out; all from the settings, so that every client agrees."""
    train_ids, val_ids = data.split(store, config.val_fraction, config.seed)
    table = store.episodes
    parts = partition.partition(
        table[table.episode_id.isin(train_ids)],
        config.num_clients,
        config.partition,
        seed=config.seed,
        alpha=config.dirichlet_alpha,
    )
    partition.check_partition(parts, train_ids)
    held_out = _deal_out(table, parts, val_ids)
    return [Share(list(part), held) for part, held in zip(parts, held_out, strict=True)]


def held_out_episodes(store: data.FrameStore, config: Config) -> list[int]:
    """Episodes no client trains on: what the global model is validated on."""
    return data.split(store, config.val_fraction, config.seed)[1]


def validate(
    bundle: model.Bundle, store: data.FrameStore, episode_ids: Sequence[int], config: Config
) -> tuple[int, dict[str, float]]:
    """Measure a policy on every fifth frame of the episodes: number of frames, and `train.measure_frames`' averages."""
    frames = held_out_frames(bundle, store, episode_ids, config)
    return (len(frames["loss"]), train.average(frames)) if frames else (0, {})


def held_out_frames(
    bundle: model.Bundle, store: data.FrameStore, episode_ids: Sequence[int], config: Config
) -> dict[str, np.ndarray]:
    """Return `train.measure_frames` of every fifth frame of the episodes; nothing if there are no episodes."""
    batches = held_out_batches(store, episode_ids, config)
    if not batches:
        return {}
    return train.measure_frames(bundle, batches, tolerance=config.action_tolerance_deg, seed=config.seed)


def by_episode(
    frames: dict[str, np.ndarray], store: data.FrameStore, episode_ids: Sequence[int]
) -> list[dict[str, float]]:
    """Return averages for each episode of what `held_out_frames` measured, with episode_id and num_examples."""
    counts = [len(range(start, end, VALIDATION_STRIDE)) for start, end in _spans(store, episode_ids)]
    ends = np.cumsum(counts)
    of_each = [{name: of[end - n : end] for name, of in frames.items()} for n, end in zip(counts, ends, strict=True)]
    return [
        {"episode_id": episode, "num_examples": n, **train.average(of)}
        for episode, n, of in zip(episode_ids, counts, of_each, strict=True)
    ]


def roll_out(
    bundle: model.Bundle, config: Config, seeds: Sequence[int], videos_dir: Path | None = None, progress: bool = False
) -> list[dict[str, Any]]:
    """Let one model act on all tasks of the mix, in the laboratories of the run, and return a row for each attempt."""
    return evaluate(
        model.PolicyActor(bundle, config.seed), task_names(config), seeds, image_size=config.image_size,
        labs=labs(config.num_labs), videos_dir=videos_dir, progress=progress,
    )  # fmt: skip


def held_out_batches(store: data.FrameStore, episode_ids: Sequence[int], config: Config) -> list[dict[str, Any]]:
    """Return raw batches of every fifth frame of the given episodes, without augmentation."""
    rows = [row for start, end in _spans(store, episode_ids) for row in range(start, end, VALIDATION_STRIDE)]
    cuts = range(0, len(rows), VALIDATION_BATCH)
    return [data.frames(store, rows[i : i + VALIDATION_BATCH], config.chunk_size) for i in cuts]


def num_frames(store: data.FrameStore, episode_ids: Sequence[int]) -> int:
    """Number of frames in the given episodes."""
    return sum(end - start for start, end in _spans(store, episode_ids))


def tasks_of(store: data.FrameStore, episode_ids: Sequence[int]) -> list[str]:
    """Return the simulated tasks among the given episodes, in a fixed order."""
    held = set(store.episodes.set_index("episode_id").loc[list(episode_ids), "task"])
    return [task for task in ALL_TASKS if task in held]


def labs_of(store: data.FrameStore, episode_ids: Sequence[int], config: Config) -> list[Lab]:
    """Return the laboratories in which the given episodes were recorded."""
    there = labs(config.num_labs)
    found = sorted(set(store.episodes.set_index("episode_id").loc[list(episode_ids), "lab"]))
    return [there[int(index)] for index in found if index < len(there)] or [REFERENCE]


def client_seed(seed: int, partition_id: int) -> int:
    """Return the seed of a client's own random stream; streams of different clients and runs do not overlap."""
    return int(np.random.SeedSequence([seed, partition_id]).generate_state(1)[0])


def keeps(config: Config) -> dict[str, bool]:
    """Whether clients keep something from round to round, by the setting that makes them."""
    return {
        f"strategy={config.strategy}": config.strategy == "scaffold", "keep-optimizer": config.keep_optimizer,
        f"exchange={config.exchange}": config.exchange != "float32", "personal": bool(config.personal),
    }  # fmt: skip


def is_validated(config: Config, round_number: int) -> bool:
    """Whether the global model of a round is kept and measured: every `validate_every` rounds, and whenever it acts."""
    return round_number % config.validate_every == 0 or rolls_out(config, round_number)


def rolls_out(config: Config, round_number: int) -> bool:
    """Whether a round ends with closed-loop rollouts: every `eval_every` rounds, and the last."""
    due = config.eval_every > 0 and round_number % config.eval_every == 0
    return due or round_number == config.num_server_rounds


def _deal_out(table: Any, parts: list[list[int]], val_ids: Sequence[int]) -> list[list[int]]:
    """Give each held-out episode to a client that trains on its task, the one with the fewest held-out so far."""
    task = dict(zip(table.episode_id, table.task, strict=True))
    tasks_held = [{task[episode] for episode in part} for part in parts]
    held_out: list[list[int]] = [[] for _ in parts]
    for episode in sorted(val_ids):
        holders = [k for k, held in enumerate(tasks_held) if task[episode] in held] or range(len(parts))
        held_out[min(holders, key=lambda k: (len(held_out[k]), k))].append(episode)
    return held_out


def _spans(store: data.FrameStore, episode_ids: Sequence[int]) -> list[tuple[int, int]]:
    rows = store.episodes.set_index("episode_id").loc[list(episode_ids)]
    return list(zip(rows.start.astype(int), rows.end.astype(int), strict=True))
