"""Image augmentation for training: shift, contrast, brightness."""

import numpy as np
import torch

SHIFT_SHARE = 0.01  # largest random shift, as a fraction of the image side: 1 pixel of 96
CONTRAST, BRIGHTNESS = 0.2, 0.1  # half ranges: contrast factor 1 +- 0.2, brightness offset +- 0.1 of full scale


def augmented(images: dict[str, np.ndarray], rng: np.random.Generator) -> dict[str, torch.Tensor]:
    """Return uint8 (B, H, W, 3) images of each camera as float32 (B, 3, H, W) in [0, 1], randomly augmented.

    Shifts are drawn per camera, as if its mount had moved; contrast and brightness are the same for all cameras.
    """
    batch_size = len(next(iter(images.values())))
    drawn = rng.uniform(1 - CONTRAST, 1 + CONTRAST, batch_size), rng.uniform(-BRIGHTNESS, BRIGHTNESS, batch_size)
    contrast, brightness = torch.from_numpy(np.array(drawn, np.float32)).reshape(2, -1, 1, 1, 1)
    result = {}
    for camera, pixels in images.items():
        image = to_float(_shift(pixels, rng))  # (B, 3, H, W)
        mean = image.mean(dim=(1, 2, 3), keepdim=True)
        result[camera] = image.mul_(contrast).add_(mean * (1 - contrast) + brightness).clamp_(0.0, 1.0)
    return result


def _shift(images: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Shift uint8 (B, H, W, 3) by a few pixels, repeating the edge: the pad-and-crop of DrQ (arXiv:2004.13649)."""
    _, height, width, _ = images.shape
    pad = max(1, round(SHIFT_SHARE * height))
    padded = np.pad(images, ((0, 0), (pad, pad), (pad, pad), (0, 0)), mode="edge")
    tops, lefts = rng.integers(0, 2 * pad + 1, (2, len(images)))
    crops = zip(padded, tops, lefts, strict=True)
    return np.stack([image[top : top + height, left : left + width] for image, top, left in crops])


def to_float(images: np.ndarray) -> torch.Tensor:
    """uint8 (B, H, W, 3) -> float32 (B, 3, H, W) in [0, 1]."""
    return torch.from_numpy(images).permute(0, 3, 1, 2).contiguous().to(torch.float32).div_(255.0)
