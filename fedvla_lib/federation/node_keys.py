"""Numbers bound to node keys: a client signs the number that it claims, the server checks it with that number's key.

Flower lets a node in if its key is registered, and tells the ServerApp no more about it. So that one lab cannot take
another's place, each signs run, node id and number (ECDSA on P-384 with SHA-256) when it introduces itself. The node id
is in it so that no other node can introduce itself with the same signature. Later replies are not signed: a registered
node that guesses the id of a message to another could answer it.
"""

from collections.abc import Callable
from pathlib import Path

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from fedvla_lib.policy.parameters import ParameterError

UNREADABLE = (OSError, ValueError, TypeError, UnsupportedAlgorithm)  # a file, its format, a password, a kind of key
ALGORITHM = ec.ECDSA(hashes.SHA256())
# Called with a node's id, the number that it claims and its signature; raises ParameterError if it is not that node's.
Proof = Callable[[int, int, object], None]


def sign(private_key: Path, run_id: int, node_id: int, partition_id: int) -> bytes:
    """Return a node's signature of the number it claims; ValueError if the file holds no key that can sign."""
    try:
        key = serialization.load_ssh_private_key(Path(private_key).read_bytes(), None)
    except UNREADABLE as error:
        raise ValueError(f"{private_key} is not a private key of `fedvla credentials`: {error}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise ValueError(f"{private_key} is not a key of an elliptic curve, as `fedvla credentials` makes them")
    return key.sign(_claim(run_id, node_id, partition_id), ALGORITHM)


def proof(folder: Path, run_id: int) -> Proof:
    """Return the check of signatures with the public keys of a folder, ``node_3.pub`` for number 3.

    Raises:
        ValueError: there are no such keys in the folder, or one cannot be read.
    """
    keys = {file.name: _public(file) for file in folder.glob("node_*.pub")}
    if not keys:
        raise ValueError(f"node-keys={str(folder)!r} has no node_K.pub: give the folder `fedvla credentials` wrote")

    def check(node_id: int, partition_id: int, signature: object) -> None:
        name = f"node_{partition_id}.pub"
        if name not in keys:
            raise ParameterError("key", f"partition-id={partition_id}: there is no {name} to check it with")
        try:
            if not isinstance(signature, bytes):
                raise InvalidSignature
            keys[name].verify(signature, _claim(run_id, node_id, partition_id), ALGORITHM)
        except InvalidSignature as error:
            text = f"node {node_id} claims partition-id={partition_id} without a signature by the key {name}"
            raise ParameterError("key", text) from error

    return check


def _public(file: Path) -> ec.EllipticCurvePublicKey:
    try:
        key = serialization.load_ssh_public_key(file.read_bytes())
    except UNREADABLE as error:
        raise ValueError(f"{file} is not a public key of `fedvla credentials`: {error}") from error
    if not isinstance(key, ec.EllipticCurvePublicKey):
        raise ValueError(f"{file} is not a key of an elliptic curve, as `fedvla credentials` makes them")
    return key


def _claim(run_id: int, node_id: int, partition_id: int) -> bytes:
    return f"fedvla run {run_id} node {node_id} partition {partition_id}".encode()
