"""The training loop of one policy, for a client's round and for centralized training.

Schedule and clipping are SmolVLA's presets in LeRobot, the optimiser is one of `optimizers`; the loss is the policy's
flow-matching loss with padded actions masked.
"""

import json
import time
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.common.train_utils import load_training_state, save_training_state
from lerobot.utils.random_utils import get_rng_state, set_rng_state, set_seed
from safetensors.torch import load_file, save_file
from tqdm.auto import tqdm

from fedvla_lib.config import Config
from fedvla_lib.files import new_folder, read_json
from fedvla_lib.policy import optimizers
from fedvla_lib.policy.model import Bundle, use_threads
from fedvla_lib.policy.parameters import Arrays, trainable
from fedvla_lib.policy.prefix_cache import PREFIX_KEY, prefix_loss

Parameters = Mapping[str, torch.nn.Parameter]
Correction = Callable[[Parameters], None]  # changes gradients in place, after the backward pass, before clipping
WEIGHTS_FILE = "trainable.safetensors"
LOSSES_FILE = "losses.json"
Loss = Callable[[Bundle, dict[str, Any]], torch.Tensor]  # of a policy on a raw batch


@dataclass(frozen=True)
class TrainResult:
    """Result of local training."""

    losses: list[float]  # flow-matching loss of each gradient step, in order
    num_examples: int  # training frames of the client: its weight in federated averaging
    steps: int  # of the optimiser, counted as it took them, and those before a resume
    seconds: float  # wall time of this call
    moments: Arrays = field(default_factory=dict)  # optimiser state by name; empty unless `Start.moments` was given
    second_moments: Arrays = field(default_factory=dict)  # by parameter, if the local optimiser shares them


@dataclass(frozen=True)
class Start:
    """Where a call of `local_train` starts in a longer run."""

    step: int = 0  # gradient steps of earlier rounds: position in the data and in the learning-rate schedule
    total_steps: int | None = None  # length of the schedule; None ends it with the call
    moments: Arrays | None = None  # optimiser state of an earlier result; {} starts fresh and returns the state
    second_moments: Arrays = field(default_factory=dict)  # the server's, for a local optimiser that shares them


@dataclass(frozen=True)
class Checkpoints:
    """Write ``step_NNNNNN`` folders every `config.checkpoint_every` gradient steps and at the end."""

    folder: Path
    resume: bool = False  # continue from the newest one; the result is bit-identical


@dataclass(frozen=True)
class Objective:
    """The loss, and a correction of its gradient."""

    loss: Loss | None = None  # None: the policy's flow-matching loss
    correction: Correction | None = None  # applied before clipping: FedProx, SCAFFOLD


FRESH, FLOW_MATCHING = Start(), Objective()


def local_train(
    bundle: Bundle, batches: Any, config: Config, *, steps: int, start: Start = FRESH,
    checkpoints: Checkpoints | None = None, objective: Objective = FLOW_MATCHING, progress: bool = True,
) -> TrainResult:  # fmt: skip
    """Train the policy's trainable parameters in place for `steps` gradient steps.

    Args:
        batches: an endless stream like `data.batches.Batches`: ``seed``, ``num_examples`` and ``at(step)``.

    Raises:
        FloatingPointError: the loss is not finite; checkpoints so far are kept.
    """
    use_threads(config, bundle.policy)
    began, loss = time.perf_counter(), objective.loss or flow_loss
    with seeded(batches.seed, start.step):
        length = start.total_steps or start.step + steps
        optimizer, scheduler = optimizers.build(bundle, config, start.step, length, start.second_moments)
        _load_moments(bundle, optimizer, start.moments or {})
        losses, taken, parameters = _restore(bundle, optimizer, scheduler, checkpoints), [], trainable(bundle.policy)
        optimizer.register_step_post_hook(lambda *_: taken.append(1))  # counts what the optimiser did
        bundle.policy.train()
        done = len(losses)
        bar = tqdm(range(done, steps), initial=done, total=steps, desc="training", disable=not progress)
        for step in bar:
            with torch.autocast(torch.device(config.device).type, torch.bfloat16, enabled=config.mixed_precision):
                value = loss(bundle, batches.at(start.step + step))
            losses.append(_step(bundle, parameters, value, optimizer, scheduler, objective.correction))
            if not np.isfinite(losses[-1]):
                raise FloatingPointError(f"loss is {losses[-1]} at step {start.step + step}: lower lr={config.lr}")
            bar.set_postfix(loss=f"{losses[-1]:.3f}")
            due = config.checkpoint_every > 0 and (step + 1) % config.checkpoint_every == 0
            if checkpoints and (due or step + 1 == steps):
                _checkpoint(bundle, optimizer, scheduler, losses, Path(checkpoints.folder))
        bundle.policy.eval()
        after = {} if start.moments is None else _moments(bundle, optimizer)
        shares = config.local_optimizer in optimizers.SHARING
        squares = optimizers.second_moments_of(bundle, optimizer) if shares else {}
    return TrainResult(losses, batches.num_examples, done + len(taken), time.perf_counter() - began, after, squares)


def _step(
    bundle: Bundle, parameters: Parameters, loss: torch.Tensor, optimizer: torch.optim.Optimizer, scheduler: Any,
    correction: Correction | None,
) -> float:  # fmt: skip
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    if correction:
        correction(parameters)
    torch.nn.utils.clip_grad_norm_(parameters.values(), bundle.policy.config.optimizer_grad_clip_norm)
    optimizer.step()
    scheduler.step()
    return loss.item()


def flow_loss(bundle: Bundle, batch: dict[str, Any]) -> torch.Tensor:
    """The policy's loss, from a cached prefix if the batch has one; noise and time are sampled alike in both cases."""
    if PREFIX_KEY not in batch:
        return bundle.policy.forward(bundle.preprocess(batch))[0]
    model, settings = bundle.policy.model, bundle.policy.config
    shape = (len(batch["task"]), settings.chunk_size, settings.max_action_dim)
    noise = model.sample_noise(shape, settings.device)
    return prefix_loss(bundle, batch, noise, model.sample_time(shape[0], settings.device))


def _moments(bundle: Bundle, optimizer: torch.optim.Optimizer) -> Arrays:
    """Copies of the optimiser's tensors, named ``<parameter>|<exp_avg, exp_avg_sq or step>``."""
    return {
        f"{name}|{kind}": value.detach().cpu().numpy().copy()
        for name, parameter in trainable(bundle.policy).items()
        for kind, value in optimizer.state.get(parameter, {}).items()
    }


def _load_moments(bundle: Bundle, optimizer: torch.optim.Optimizer, moments: Arrays) -> None:
    """Restore the optimiser state that `_moments` returned."""
    named = trainable(bundle.policy)
    for key, value in moments.items():
        name, kind = key.rsplit("|", 1)
        device = "cpu" if kind == "step" else named[name].device  # PyTorch keeps the step count on the CPU
        optimizer.state[named[name]][kind] = torch.from_numpy(value.copy()).to(device)


@contextmanager
def seeded(seed: int, start_step: int) -> Iterator[None]:
    """Seed all global random generators by (seed, start_step), and restore the caller's random state at the end."""
    before = get_rng_state()
    set_seed(int(np.random.SeedSequence([seed, start_step]).generate_state(1)[0]))
    try:
        yield
    finally:
        set_rng_state(before)


def _checkpoint(bundle: Bundle, optimizer: Any, scheduler: Any, losses: list[float], folder: Path) -> None:
    """Write ``step_NNNNNN`` atomically: weights, optimiser, schedule, random state, losses."""
    with new_folder(folder / f"step_{len(losses):06d}", replace=True) as draft:
        save_training_state(draft, len(losses), optimizer, scheduler)
        weights = {name: p.detach().contiguous() for name, p in trainable(bundle.policy).items()}
        save_file(weights, draft / WEIGHTS_FILE)
        (draft / LOSSES_FILE).write_text(json.dumps(losses))


def _restore(bundle: Bundle, optimizer: Any, scheduler: Any, checkpoints: Checkpoints | None) -> list[float]:
    """Load the newest checkpoint in place and return its losses; an empty list if there is none to resume."""
    folders = sorted(Path(checkpoints.folder).glob("step_*")) if checkpoints and checkpoints.resume else []
    if not folders:
        return []
    newest = folders[-1]
    load_training_state(newest, optimizer, scheduler)
    saved, parameters = load_file(newest / WEIGHTS_FILE), trainable(bundle.policy)
    if set(saved) != set(parameters):
        raise ValueError(f"{newest} holds {len(saved)} trainable arrays, the policy has {len(parameters)}")
    with torch.no_grad():
        for name, parameter in parameters.items():
            parameter.copy_(saved[name])
    return read_json(newest / LOSSES_FILE, list[float])


def with_gradient(parameters: Parameters, shared: Container[str]) -> list[tuple[str, torch.nn.Parameter]]:
    """Parameters to correct: those in `shared` (not personal to the client) that the backward pass reached."""
    return [(name, p) for name, p in parameters.items() if p.grad is not None and name in shared]
