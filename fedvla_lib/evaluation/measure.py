"""Measure one model once: held-out loss and action error, then closed-loop success."""

from collections.abc import Sequence

from fedvla_lib.config import Config
from fedvla_lib.data import frame_store
from fedvla_lib.evaluation import held_out
from fedvla_lib.evaluation.held_out import held_out_frames
from fedvla_lib.policy import model


def measure_held_out(
    bundle: model.Bundle, store: frame_store.FrameStore, episode_ids: Sequence[int], config: Config
) -> tuple[int, dict[str, float]]:
    """Measure a policy on every fifth frame of the episodes: number of frames, and `train.measure_frames`' averages."""
    frames = held_out_frames(bundle, store, episode_ids, config)
    return (len(frames["loss"]), held_out.average(frames)) if frames else (0, {})


def is_validated(config: Config, round_number: int) -> bool:
    """Whether the global model of a round is kept and measured: every `validate_every` rounds, and whenever it acts."""
    return round_number % config.validate_every == 0 or rolls_out(config, round_number)


def rolls_out(config: Config, round_number: int) -> bool:
    """Whether a round ends with closed-loop rollouts: every `eval_every` rounds, and the last."""
    due = config.eval_every > 0 and round_number % config.eval_every == 0
    return due or round_number == config.num_server_rounds
