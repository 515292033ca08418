"""Random changes of training images: shift, contrast, brightness."""

import numpy as np
import torch

SHIFT_SHARE = 0.01  # largest random shift, as a share of the image side: 1 pixel of 96
CONTRAST, BRIGHTNESS = 0.2, 0.1  # contrast is scaled by 1 +- 0.2, brightness moved by +- 0.1 of full scale


def augmented(pictures: dict[str, np.ndarray], rng: np.random.Generator) -> dict[str, torch.Tensor]:
    """Return uint8 (B, H, W, 3) pictures of each camera as float32 (B, 3, H, W) in [0, 1], changed at random.

    Each camera's picture is shifted on its own, as if its mount were knocked; the light is common to all cameras.
    """
    batch_size = len(next(iter(pictures.values())))
    contrast = _column(rng.uniform(1 - CONTRAST, 1 + CONTRAST, batch_size))
    brightness = _column(rng.uniform(-BRIGHTNESS, BRIGHTNESS, batch_size))
    images = {}
    for camera, picture in pictures.items():
        image = to_float(_shift(picture, rng))  # (B, 3, H, W)
        mean = image.mean(dim=(1, 2, 3), keepdim=True)
        images[camera] = image.mul_(contrast).add_(mean * (1 - contrast) + brightness).clamp_(0.0, 1.0)
    return images


def _shift(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Move uint8 (B, H, W, 3) by a few pixels, repeating the edge: the pad-and-crop of DrQ (arXiv:2004.13649)."""
    _, height, width, _ = picture.shape
    most = max(1, round(SHIFT_SHARE * height))
    padded = np.pad(picture, ((0, 0), (most, most), (most, most), (0, 0)), mode="edge")
    tops, lefts = rng.integers(0, 2 * most + 1, (2, len(picture)))
    crops = zip(padded, tops, lefts, strict=True)
    return np.stack([image[top : top + height, left : left + width] for image, top, left in crops])


def to_float(picture: np.ndarray) -> torch.Tensor:
    """uint8 (B, H, W, 3) -> float32 (B, 3, H, W) in [0, 1]."""
    channels_first = torch.from_numpy(picture).permute(0, 3, 1, 2).contiguous()
    return channels_first.to(torch.float32).div_(255.0)


def _column(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32)).reshape(-1, 1, 1, 1)
