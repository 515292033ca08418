"""The part of a policy that trains, as named float32 arrays, and the checks those arrays pass before anyone uses them.

Only parameters with ``requires_grad`` travel between server and clients: names are PyTorch's, values float32 whatever
the policy computes in. This module knows torch and NumPy; it does not know Flower.
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
    """Arrays that must not be used. `kind` is one word for counting: names, dtype, shape, non-finite or hash."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


def trainable(policy: torch.nn.Module) -> dict[str, torch.nn.Parameter]:
    """Return the parameters that train, by name, in the policy's own order: the live ones, not copies."""
    return {name: parameter for name, parameter in policy.named_parameters() if parameter.requires_grad}


def trainable_arrays(policy: torch.nn.Module) -> Arrays:
    """Return copies of all trainable parameters by name, float32, in the policy's own order.

    Raises:
        ValueError: the policy has no trainable parameter.
    """
    arrays = {name: _to_numpy(parameter) for name, parameter in trainable(policy).items()}
    if not arrays:
        raise ValueError("the policy has no trainable parameter: unfreeze a part of it (train-expert-only, base)")
    return arrays


def load_arrays(policy: torch.nn.Module, arrays: Mapping[str, np.ndarray]) -> None:
    """Overwrite every trainable parameter of `policy` with `arrays`; nothing is written unless all of them fit.

    Raises:
        ParameterError: a name, shape or dtype differs, or a value is not finite.
    """
    parameters = trainable(policy)
    check_arrays(arrays, {name: tuple(p.shape) for name, p in parameters.items()})
    with torch.no_grad():
        for name, parameter in parameters.items():
            parameter.copy_(torch.from_numpy(np.array(arrays[name])))  # a copy: torch wants writable memory


def layer_of(name: str) -> str:
    """Return which part of SmolVLA a parameter belongs to: ``expert layer N``, or ``projections`` around the expert."""
    found = LAYER.search(name)
    return f"expert layer {found[1]}" if found else "projections"


def shapes_of(arrays: Mapping[str, np.ndarray]) -> Shapes:
    """Return the shape of each array by name: the reference that replies are checked against."""
    return {name: tuple(array.shape) for name, array in arrays.items()}


def digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of names, shapes, dtypes and values as 64 hex digits; the order of names does not matter."""
    sha = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        sha.update(f"{name}|{array.dtype.str}|{arrays[name].shape}|".encode())
        sha.update(array.data)
    return sha.hexdigest()


def check_arrays(
    arrays: Mapping[str, np.ndarray], reference_shapes: Shapes, expected_digest: str | None = None
) -> None:
    """Return if `arrays` have exactly the reference names and shapes, are finite float32 and match the digest.

    Raises:
        ParameterError: with the first thing that is wrong, the name of the array and what was expected.
    """
    _check_names(set(arrays), set(reference_shapes))
    for name, shape in reference_shapes.items():
        _check_one(name, arrays[name], shape)
    if expected_digest is not None:
        check_digest(arrays, expected_digest)


def check_digest(arrays: Mapping[str, np.ndarray], expected_digest: str) -> None:
    """Return if the arrays have the digest that was announced.

    Raises:
        ParameterError: they do not.
    """
    if (found := digest(arrays)) != expected_digest:
        raise ParameterError("hash", f"SHA-256 is {found[:12]}..., announced was {expected_digest[:12]}...")


def _check_names(names: set[str], expected: set[str]) -> None:
    found = {"missing": sorted(expected - names), "unknown": sorted(names - expected)}
    parts = [f"{len(those)} {word} (first {those[0]!r})" for word, those in found.items() if those]
    if parts:
        raise ParameterError("names", f"{len(expected)} arrays expected: {' and '.join(parts)}")


def _check_one(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.dtype != np.float32:
        raise ParameterError("dtype", f"array {name!r} has dtype {array.dtype}, expected float32")
    if tuple(array.shape) != shape:
        raise ParameterError("shape", f"array {name!r} has shape {tuple(array.shape)}, expected {shape}")
    if not np.isfinite(array).all():
        bad = int(array.size - np.isfinite(array).sum())
        raise ParameterError("non-finite", f"array {name!r} holds {bad} values that are not finite")


def _to_numpy(parameter: torch.nn.Parameter) -> np.ndarray:
    return parameter.detach().to("cpu", torch.float32, copy=True).numpy()
