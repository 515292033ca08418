"""Exchange with fewer bits per number, and error feedback: rounding errors are carried over to the next round.

A client sends its update, rounded. The rounding error is added to its next update before that is rounded, so that over
rounds the server receives the sum of all updates up to one rounding error (error feedback: Seide et al. 2014;
Karimireddy et al. 2019, https://arxiv.org/abs/1901.09847). The server sends the model itself, with 16 bits if the
exchange has fewer than 32, and adds updates to its own unrounded arrays.
"""

import numpy as np

from fedvla_lib.policy.parameters import Arrays, ParameterError, Shapes

DOWNWARD = {"float32": "float32", "float16": "float16", "int8": "float16"}  # exchange -> type of the server's arrays
SCALE = "|scale"  # beside an int8 array: the value of one step
LEVELS = 127  # int8 without -128, so that the range is symmetric


def encode(arrays: Arrays, exchange: str) -> Arrays:
    """Round float32 arrays to the type of `exchange`; int8 adds a float32 ``<name>|scale`` of shape () for each."""
    if exchange == "float32":
        return arrays
    if exchange == "float16":
        limit = np.finfo(np.float16).max
        return {name: np.clip(array, -limit, limit).astype(np.float16) for name, array in arrays.items()}
    encoded: Arrays = {}
    for name, array in arrays.items():
        scale = np.float32(np.abs(array).max(initial=0) / LEVELS)
        encoded[name] = np.rint(array / (scale or 1)).astype(np.int8)
        encoded[name + SCALE] = np.asarray(scale)
    return encoded


def decode(encoded: Arrays, exchange: str) -> Arrays:
    """Return float32 arrays from what `encode` returned, up to rounding."""
    if exchange == "int8":
        names = [name for name in encoded if not name.endswith(SCALE)]
        return {name: encoded[name].astype(np.float32) * encoded[name + SCALE] for name in names}
    return {name: array.astype(np.float32) for name, array in encoded.items()}


def with_feedback(change: Arrays, left_over: Arrays, exchange: str) -> tuple[Arrays, Arrays]:
    """Encode an update plus the rounding error of earlier ones; return it and the new rounding error."""
    wanted = {name: array + left_over[name] if left_over else array for name, array in change.items()}
    encoded = encode(wanted, exchange)
    arrived = decode(encoded, exchange)
    return encoded, {name: array - arrived[name] for name, array in wanted.items()}


def check_encoded(encoded: Arrays, shapes: Shapes, exchange: str) -> None:
    """Raise ParameterError unless `encoded` decodes to finite arrays of these names and shapes."""
    wanted = dict(shapes) | ({name + SCALE: () for name in shapes} if exchange == "int8" else {})
    if set(encoded) != set(wanted):
        odd = sorted(set(encoded) ^ set(wanted))[0]
        raise ParameterError("names", f"{len(wanted)} arrays expected for exchange={exchange}: {odd!r} differs")
    for name, shape in wanted.items():
        dtype = np.float32 if name.endswith(SCALE) else np.dtype(exchange)
        if encoded[name].dtype != dtype or encoded[name].shape != shape:
            found = f"{encoded[name].dtype} {encoded[name].shape}"
            raise ParameterError("dtype", f"array {name!r} is {found}, expected {np.dtype(dtype)} {shape}")
        if not np.isfinite(encoded[name]).all():
            raise ParameterError("non-finite", f"array {name!r} holds values that are not finite")
