"""Messages between server and clients: the names of Flower's records, and packing and checking on either side.

Server to client: ``arrays`` (global parameters) and ``config`` (round, digest, pooled statistics).
Client to server: ``arrays``, ``metrics`` (numbers that Flower averages) and ``note`` (round, digest, everything else).
SCAFFOLD adds ``control`` both ways, control variates, and some local optimisers ``second_moments``; both are checked
like the arrays.
"""

import io
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from flwr.app import Array, ArrayRecord, ConfigRecord, RecordDict
from flwr.common.serde import recorddict_to_proto

from fedvla_lib.federation.quantisation import check_encoded, decode
from fedvla_lib.policy.parameters import Arrays, ParameterError, Shapes, check_arrays, check_digest, digest
from fedvla_lib.robot.spec import JOINT_NAMES

ARRAYS, CONFIG, METRICS, NOTE = "arrays", "config", "metrics", "note"  # records
CONTROL, SECOND_MOMENTS = EXTRA = "control", "second_moments"  # records of arrays that some settings add

ROUND = "server-round"  # Flower's own key
EXAMPLES = "num-examples"  # training frames: the weight of a client
STEPS = "steps"  # gradient steps that the client counted while training
DIGEST = "sha256"  # of the arrays
PROXIMAL_MU = "proximal-mu"  # Flower's own key
KEY = "key"  # in a node's config: the file of its private key, to sign its number with
DATA = "data"  # in a node's config: the client's own data set
PARTITION = "partition-id"  # Flower's own key in a node's config
STATS = "stats"
NPY_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}

# Exactly the numbers of a reply: Flower only averages records with equal keys.
TRAIN_METRICS = (EXAMPLES, STEPS, "seconds", "loss")
EVALUATE_METRICS = (EXAMPLES, "loss", "action_error", "action_accuracy", *(f"action_error.{j}" for j in JOINT_NAMES))


def train_metrics(hides_updates: bool) -> tuple[str, ...]:
    """Return the numbers of a training reply; a client that hides its update keeps its loss for itself."""
    return TRAIN_METRICS[:-1] if hides_updates else TRAIN_METRICS


def pack_arrays(arrays: Mapping[str, np.ndarray]) -> ArrayRecord:
    """Return named arrays as Flower's record."""
    return ArrayRecord({name: Array(np.asarray(array)) for name, array in arrays.items()})


def unpack_arrays(record: ArrayRecord) -> Arrays:
    """Return the arrays of a record by name.

    Raises:
        ParameterError: the bytes of an array cannot be decoded, or differ from the declaration.
    """
    arrays = {}
    for name, array in record.items():
        try:
            arrays[name] = _numbers(name, array).copy()  # of its own, writable memory
        except ParameterError:
            raise
        # NumPy parses the header as Python, which can fail in many ways; none of them may end the run.
        except Exception as error:
            raise ParameterError("dtype", f"array {name!r} cannot be decoded: {error}") from error
    return arrays


def digest_key(record: str) -> str:
    """Return the key of the SHA-256 of a record of arrays."""
    return DIGEST if record == ARRAYS else f"{DIGEST}-{record}"


def attach(content: RecordDict, digest_in: str, record: str, arrays: Arrays) -> None:
    """Add a record of arrays, and its SHA-256 to record `digest_in`."""
    content[record] = pack_arrays(arrays)
    content[digest_in][digest_key(record)] = digest(arrays)


def checked_arrays(
    content: RecordDict, digest_in: str, shapes: Shapes, record: str = ARRAYS,
    also: tuple[str, ...] = (), exchange: str = "float32",
) -> Arrays:  # fmt: skip
    """Unpack `record` and check names, shapes, finiteness and the SHA-256 in record `digest_in`.

    Args:
        digest_in: `NOTE` of a client, who has to announce a SHA-256, or `CONFIG` of a server, who may announce none at
            all: Flower's stock strategies do not.
        also: other records of arrays that are allowed.
        exchange: how the arrays were encoded; they are returned as float32.

    Raises:
        ParameterError: what is wrong, in one line.
    """
    key, said = digest_key(record), content.config_records.get(digest_in, {})
    announced, unchecked = said.get(key), digest_in == CONFIG and DIGEST not in said
    names = list(content.array_records)
    if record not in names or set(names) - {record, *also}:
        raise ParameterError("names", f"expected one record {record!r} of arrays, got {names}")
    if not (isinstance(announced, str) or unchecked and announced is None):
        raise ParameterError("hash", f"there is no SHA-256 under {digest_in}.{key}")
    arrays = unpack_arrays(content.array_records[record])
    if exchange == "float32":
        if unchecked:  # Flower's adaptive strategies compute in float64
            arrays = {name: array.astype(np.float32, copy=False) for name, array in arrays.items()}
        check_arrays(arrays, shapes, announced)
        return arrays
    check_encoded(arrays, shapes, exchange)
    if announced is not None:
        check_digest(arrays, announced)
    arrays = decode(arrays, exchange)
    check_arrays(arrays, shapes)  # finite steps of a finite scale can be infinite
    return arrays


def count_bytes(content: RecordDict) -> int:
    """Return the bytes of a message's records: arrays as Flower counts them, the rest as serialised."""
    # Flower's `ConfigRecord.count_bytes` fails on an empty list or text.
    rest = RecordDict({name: record for name, record in content.items() if name not in content.array_records})
    return sum(record.count_bytes() for record in content.array_records.values()) + recorddict_to_proto(rest).ByteSize()


def round_of(content: RecordDict) -> dict[str, Any]:
    """Return the round of a server's message, as what a reply's note says of it."""
    return {ROUND: content.config_records.get(CONFIG, {}).get(ROUND, 0)}


def check_round(content: RecordDict, server_round: int) -> None:
    """Raise ParameterError unless a reply's note names the round: another one's content was sent again."""
    if (found := content.config_records.get(NOTE, {}).get(ROUND)) != server_round:
        raise ParameterError("round", f"the reply is of round {found!r}, expected {server_round}")


def make_note(**values: Any) -> ConfigRecord:
    """Return the client's note; underscores in keywords become dashes."""
    return ConfigRecord({key.replace("_", "-"): value for key, value in values.items()})


def _numbers(name: str, array: Array) -> np.ndarray:
    """Return a view of an array's bytes, after comparing the header with the declaration and the number of bytes.

    `np.load` would open an archive, or allocate as many numbers as the header claims.
    """
    file = io.BytesIO(array.data)
    version = np.lib.format.read_magic(file)
    if version not in NPY_HEADERS:
        raise ValueError(f".npy version {version}, expected one of {sorted(NPY_HEADERS)}")
    shape, by_column, dtype = NPY_HEADERS[version](file)
    if dtype.kind not in "biufc" or str(dtype) != array.dtype:
        raise ParameterError("dtype", f"array {name!r} holds {dtype}, expected numbers of the declared {array.dtype!r}")
    if shape != tuple(array.shape):
        raise ParameterError("shape", f"array {name!r} has shape {shape}, declared as {tuple(array.shape)}")
    if (wanted := math.prod(shape) * dtype.itemsize) != (found := len(array.data) - file.tell()):
        raise ParameterError("shape", f"array {name!r} of shape {shape} needs {wanted} bytes, has {found}")
    return np.ndarray(shape, dtype, array.data, file.tell(), order="F" if by_column else "C")
