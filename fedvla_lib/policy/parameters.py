"""The trainable parameters of a policy as named float32 arrays, and the checks of arrays before they are used.

Only parameters with ``requires_grad`` are exchanged, under PyTorch's names and as float32, whatever the policy computes
in. Knows torch and NumPy, but not Flower.
"""

import hashlib
import re
from collections.abc import Mapping

import numpy as np
import torch

Arrays = dict[str, np.ndarray]
Shapes = dict[str, tuple[int, ...]]
LAYER = re.compile(r"lm_expert.*?\.layers\.(\d+)\.")


class ParameterError(ValueError):
    """Invalid arrays. `kind` is the type of error, used for counting: names, dtype, shape, non-finite or hash."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


def trainable(policy: torch.nn.Module) -> dict[str, torch.nn.Parameter]:
    """Return the trainable parameters by name, in the policy's order (the live ones, not copies)."""
    return {name: parameter for name, parameter in policy.named_parameters() if parameter.requires_grad}


def trainable_arrays(policy: torch.nn.Module) -> Arrays:
    """Return copies of all trainable parameters by name, float32, in the policy's order; ValueError without any."""
    arrays = {name: p.detach().to("cpu", torch.float32, copy=True).numpy() for name, p in trainable(policy).items()}
    if not arrays:
        raise ValueError("the policy has no trainable parameter: unfreeze a part of it (train-expert-only, base)")
    return arrays


def load_arrays(policy: torch.nn.Module, arrays: Mapping[str, np.ndarray]) -> None:
    """Overwrite all trainable parameters of `policy` with `arrays`; nothing is written unless all are valid.

    Raises:
        ParameterError: a name, shape or dtype differs, or a value is not finite.
    """
    parameters = trainable(policy)
    check_arrays(arrays, {name: tuple(p.shape) for name, p in parameters.items()})
    with torch.no_grad():
        for name, parameter in parameters.items():
            parameter.copy_(torch.from_numpy(np.array(arrays[name])))  # a copy, since torch needs writable memory


def layer_of(name: str) -> str:
    """Return the part of SmolVLA that a parameter belongs to: ``expert layer N`` or ``projections``."""
    match = LAYER.search(name)
    return f"expert layer {match[1]}" if match else "projections"


def shapes_of(arrays: Mapping[str, np.ndarray]) -> Shapes:
    """Return the shapes of the arrays by name, to check replies against."""
    return {name: tuple(array.shape) for name, array in arrays.items()}


def digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of names, shapes, dtypes and values as 64 hex digits; it does not depend on the order."""
    sha = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        sha.update(f"{name}|{array.dtype.str}|{arrays[name].shape}|".encode())
        sha.update(array.data)
    return sha.hexdigest()


def check_arrays(
    arrays: Mapping[str, np.ndarray], reference_shapes: Shapes, expected_digest: str | None = None
) -> None:
    """Check that `arrays` have exactly the reference names and shapes, are finite float32 and match the digest.

    Raises:
        ParameterError: the first error found, with the name of the array and what was expected.
    """
    differences = {"missing": set(reference_shapes) - set(arrays), "unknown": set(arrays) - set(reference_shapes)}
    if parts := [f"{len(wrong)} {word} (first {min(wrong)!r})" for word, wrong in differences.items() if wrong]:
        raise ParameterError("names", f"{len(reference_shapes)} arrays expected: {' and '.join(parts)}")
    for name, shape in reference_shapes.items():
        array = arrays[name]
        if array.dtype != np.float32:
            raise ParameterError("dtype", f"array {name!r} has dtype {array.dtype}, expected float32")
        if array.shape != shape:
            raise ParameterError("shape", f"array {name!r} has shape {array.shape}, expected {shape}")
        if bad := array.size - np.count_nonzero(np.isfinite(array)):
            raise ParameterError("non-finite", f"array {name!r} has {bad} non-finite values")
    if expected_digest is not None:
        check_digest(arrays, expected_digest)


def check_digest(arrays: Mapping[str, np.ndarray], expected_digest: str) -> None:
    """Raise ParameterError unless the arrays match the digest sent with them."""
    if (actual := digest(arrays)) != expected_digest:
        raise ParameterError("hash", f"SHA-256 is {actual[:12]}..., expected {expected_digest[:12]}...")
