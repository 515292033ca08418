"""Local optimisers: SmolVLA's AdamW and its variants with second moments that the server averages.

- ``adamw``: SmolVLA's preset in LeRobot, fresh in each round unless its state is kept.
- ``adamw-shared``: the second moment starts at the server's mean, the first at 0 (FedAdamW, Liu et al. 2025,
  https://arxiv.org/abs/2510.27486, without its added share of the last global movement).
- ``adamw-frozen``: the second moment is the server's throughout the round, so that a step is linear in the gradient and
  a correction such as SCAFFOLD's reaches the weights undistorted (as in Mime, Karimireddy et al. 2020,
  https://arxiv.org/abs/2008.03606).
- ``sgd``: gradient descent without momentum.

Until the server has second moments, in the first round, the two that need them train with ``adamw``.
"""

from dataclasses import replace
from typing import Any

import torch

from fedvla_lib.config import Config
from fedvla_lib.policy.model import Bundle
from fedvla_lib.policy.parameters import Arrays, trainable

SHARING = ("adamw-shared", "adamw-frozen")  # optimisers whose second moments the clients send to the server
FIRST_MOMENT = 0.9  # decay of the first moment of adamw-frozen
EPSILON = 1e-8
LATE = 1e6  # a step count at which AdamW no longer corrects its moments for their start at 0


def adamw(bundle: Bundle, config: Config, start_step: int, total_steps: int) -> tuple[torch.optim.Optimizer, Any]:
    """SmolVLA's AdamW and cosine-with-warm-up presets with the run's learning rate and length, at `start_step`."""
    settings = bundle.policy.config
    optimizer = replace(settings.get_optimizer_preset(), lr=config.lr).build(list(trainable(bundle.policy).values()))
    if str(settings.device) == "cpu":  # one call for all arrays; elsewhere PyTorch's default does so
        optimizer.param_groups[0]["fused"] = True
    return optimizer, _schedule(bundle, config, optimizer, start_step, total_steps)


def build(
    bundle: Bundle, config: Config, start_step: int, total_steps: int, second_moments: Arrays
) -> tuple[torch.optim.Optimizer, Any]:
    """Return the optimiser that the settings name, and its schedule.

    Args:
        second_moments: the server's, by parameter; empty if it has none.
    """
    named, kind = trainable(bundle.policy), config.local_optimizer
    if kind == "sgd":
        optimizer = torch.optim.SGD(named.values(), lr=config.lr)
    elif kind == "adamw-frozen" and second_moments:
        optimizer = torch.optim.SGD(named.values(), lr=config.lr, momentum=FIRST_MOMENT, dampening=1 - FIRST_MOMENT)
        roots = {p: torch.from_numpy(second_moments[name]).sqrt().to(p.device) + EPSILON for name, p in named.items()}
        optimizer.register_step_pre_hook(lambda *_: _divide(roots, optimizer))
    else:
        optimizer, schedule = adamw(bundle, config, start_step, total_steps)
        if kind == "adamw-shared" and second_moments:
            _start_late(optimizer, schedule, {p: second_moments[name] for name, p in named.items()}, start_step)
        return optimizer, schedule
    return optimizer, _schedule(bundle, config, optimizer, start_step, total_steps)


def second_moments_of(bundle: Bundle, optimizer: torch.optim.Optimizer) -> Arrays:
    """Return the mean squared gradients by parameter, without the bias of their start at 0."""
    decay = optimizer.defaults.get("betas", (0.0, 0.0))[1]
    found = {}
    for name, parameter in trainable(bundle.policy).items():
        state = optimizer.state[parameter]
        square = state["exp_avg_sq"] / (1 - decay ** float(state["step"])) if decay else state["squares"] / state["n"]
        found[name] = square.cpu().numpy()
    return found


def _schedule(bundle: Bundle, config: Config, optimizer: Any, start_step: int, total_steps: int) -> Any:
    settings = bundle.policy.config
    floor = config.lr * settings.scheduler_decay_lr / settings.optimizer_lr  # the preset's ratio of final to peak rate
    schedule = {"num_warmup_steps": config.warmup_steps, "num_decay_steps": total_steps}
    preset = replace(settings.get_scheduler_preset(), peak_lr=config.lr, decay_lr=floor, **schedule)
    scheduler = preset.build(optimizer, total_steps)
    _start_at(optimizer, scheduler, start_step)
    return scheduler


def _start_at(optimizer: Any, scheduler: Any, step: int) -> None:
    scheduler.last_epoch = step
    for group in optimizer.param_groups:
        group["lr"] = group["initial_lr"] * scheduler.lr_lambdas[0](step)


def _start_late(optimizer: Any, scheduler: Any, moments: dict[Any, Any], start_step: int) -> None:
    """Start the second moments at `moments`; the first ones are corrected through the learning rate."""
    for parameter, square in moments.items():
        optimizer.state[parameter] = {
            "step": torch.tensor(LATE), "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.from_numpy(square.copy()).to(parameter.device),
        }  # fmt: skip
    (planned,), decay = scheduler.lr_lambdas, optimizer.defaults["betas"][0]
    scheduler.lr_lambdas = [lambda step: planned(step) / (1 - decay ** (max(step - start_step, 0) + 1))]
    _start_at(optimizer, scheduler, start_step)


def _divide(roots: dict[Any, torch.Tensor], optimizer: torch.optim.Optimizer) -> None:
    """Sum the squared gradients, then divide the gradients by `roots`."""
    for parameter, root in roots.items():
        state, gradient = optimizer.state[parameter], parameter.grad
        state["squares"] = state.get("squares", 0) + gradient.square()
        state["n"] = state.get("n", 0) + 1
        gradient.div_(root)
