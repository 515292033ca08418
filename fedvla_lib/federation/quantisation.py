"""Fewer bits a number on the way to the server, and what rounding loses carried over to the next round.

A client sends the change of its arrays, rounded. What the rounding leaves out is added to the client's next change
before that is rounded in turn, so that over rounds the server receives the sum of all changes up to one rounding error
(error feedback: Seide et al. 2014; Karimireddy et al. 2019, https://arxiv.org/abs/1901.09847). The way down carries the
model itself, at 16 bits where fewer than 32 are asked for; the server adds changes to its own unrounded arrays, so
nothing is lost there either.
"""

import numpy as np

from fedvla_lib.policy.parameters import Arrays, ParameterError, Shapes

DOWNWARD = {"float32": "float32", "float16": "float16", "int8": "float16"}  # what a model travels down in
SCALE = "|scale"  # beside an int8 array: what one step of it is worth
LEVELS = 127  # int8 without its lowest value, so that both signs reach equally far


def encode(arrays: Arrays, exchange: str) -> Arrays:
    """Round float32 arrays to what `exchange` sends; int8 adds a float32 ``<name>|scale`` of shape () to each."""
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
    """Return the float32 arrays that `encode` made into `encoded`, as far as rounding kept them."""
    if exchange == "int8":
        names = [name for name in encoded if not name.endswith(SCALE)]
        return {name: encoded[name].astype(np.float32) * encoded[name + SCALE] for name in names}
    return {name: array.astype(np.float32) for name, array in encoded.items()}


def with_feedback(change: Arrays, left_over: Arrays, exchange: str) -> tuple[Arrays, Arrays]:
    """Encode a change together with what was left over from earlier ones; return it and what is left over now."""
    wanted = {name: array + left_over[name] if left_over else array for name, array in change.items()}
    encoded = encode(wanted, exchange)
    arrived = decode(encoded, exchange)
    return encoded, {name: array - arrived[name] for name, array in wanted.items()}


def check_encoded(encoded: Arrays, shapes: Shapes, exchange: str) -> None:
    """Return if `encoded` can be decoded to finite arrays of these names and shapes.

    Raises:
        ParameterError: a name, type or shape is not what `encode` makes, or a value is not finite.
    """
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
