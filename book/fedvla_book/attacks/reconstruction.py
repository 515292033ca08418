"""What it saw: the joint state and the images of a training frame, computed from a gradient or an update.

The projection of the state is linear, p = W x + b. Of one sample, dL/dW = (dL/dp) x^T and dL/db = dL/dp: their ratio is
the state itself. Of a batch it is a mean of the states, weighted by gradients that are not known. The attack needs the
projection to train (`train_state_proj`), and a reply of a single client.

For images there is no formula: the attacker searches for those whose gradient points in the same direction (Geiping et
al. 2020, https://arxiv.org/abs/2003.14053).
"""

from typing import Any

import numpy as np
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel

from fedvla_lib.policy.model import Bundle
from fedvla_lib.policy.parameters import Arrays, trainable
from fedvla_lib.robot.spec import CAMERAS, NUM_JOINTS, STATE_KEY, image_key

WEIGHT, BIAS = "model.state_proj.weight", "model.state_proj.bias"


def normalised_state(change: Arrays) -> np.ndarray:
    """Return x, float64 (6,), in normalised units, from the change of W and b: their ratio, by least squares.

    Raises:
        ValueError: the projection is not among the arrays, or has not moved.
    """
    if WEIGHT not in change:
        raise ValueError(f"{WEIGHT} is not exchanged: the state cannot be read (train-state-proj=False)")
    weight, bias = change[WEIGHT].astype(np.float64), change[BIAS].astype(np.float64)
    if not bias.any():
        raise ValueError(f"{BIAS} has not changed")
    return (bias @ weight / (bias @ bias))[:NUM_JOINTS]


def joints_deg(bundle: Bundle, normalised: np.ndarray) -> np.ndarray:
    """Return a normalised joint state in degrees (gripper 0-100)."""
    stats = next(step for step in bundle.preprocess.steps if hasattr(step, "stats")).stats[STATE_KEY]
    mean, std = (torch.as_tensor(stats[name]).double().numpy() for name in ("mean", "std"))
    return normalised * std + mean


def gradients(bundle: Bundle, batch: dict[str, Any], seed: int, **options: Any) -> list[torch.Tensor]:
    """Return the gradient of the loss on a raw batch for each trainable parameter, noise and flow time fixed by `seed`.

    `options` are passed to `torch.autograd.grad`.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        loss = bundle.policy.forward(bundle.preprocess(batch))[0]
    return list(torch.autograd.grad(loss, list(trainable(bundle.policy).values()), **options))


def search_images(
    bundle: Bundle, batch: dict[str, Any], wanted: list[torch.Tensor], *, seed: int, steps: int = 200,
    rate: float = 0.05, smoothness: float = 1e-3,
) -> tuple[dict[str, np.ndarray], float]:  # fmt: skip
    """Search for the images of a batch, from their gradient and, to help the attacker, everything else.

    Args:
        batch: raw; its images are not looked at, but state, actions and instruction are.
        wanted: the gradient, with noise and flow time of `seed`, which the attacker knows, too.
        smoothness: weight of the total variation.

    Returns:
        images, float32 (B, 3, size, size) by key, and the cosine similarity of their gradient to the one wanted.
    """
    keys = [image_key(camera) for camera in CAMERAS]
    images = {key: torch.full_like(batch[key], 0.5).requires_grad_() for key in keys}
    optimizer, cosine = torch.optim.Adam(images.values(), lr=rate), torch.zeros(())
    with sdpa_kernel(SDPBackend.MATH):  # the only one with second derivatives
        for _ in range(steps):
            found = gradients(bundle, batch | images, seed, create_graph=True, allow_unused=True)
            pairs = [(f.flatten(), w.flatten()) for f, w in zip(found, wanted, strict=True) if f is not None]
            left, right = (torch.cat(side) for side in zip(*pairs, strict=True))
            cosine = torch.nn.functional.cosine_similarity(left, right, dim=0)
            optimizer.zero_grad()
            (1 - cosine + smoothness * sum(map(_variation, images.values()))).backward()
            optimizer.step()
            with torch.no_grad():
                for image in images.values():
                    image.clamp_(0, 1)
    return {key: image.detach().numpy() for key, image in images.items()}, float(cosine.detach())


def _variation(image: torch.Tensor) -> torch.Tensor:
    return (image.diff(dim=-1).abs().mean() + image.diff(dim=-2).abs().mean()) / 2


def psnr_db(found: np.ndarray, true: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio of images in [0, 1]; below 20 dB nobody recognises the scene."""
    return float(-10 * np.log10(np.square(found - true).mean()))
