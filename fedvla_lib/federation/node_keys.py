"""Numbers bound to node keys: a client signs the number that it claims, the server checks it with that number's key.

Flower lets a node in if its key is registered, and tells the ServerApp no more about it. So that one lab cannot take
another's place, each signs run, node id and number (ECDSA on P-384 with SHA-256). The node id is in it since the
SuperLink knows which connection has it: another node cannot send the signature again.
"""

from collections.abc import Callable
from pathlib import Path

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from fedvla_lib.policy.parameters import ParameterError

ALGORITHM = ec.ECDSA(hashes.SHA256())
# Called with a node's id, the number that it claims and its signature; raises ParameterError if it is not that node's.
Proof = Callable[[int, int, object], None]


def sign(private_key: Path, run_id: int, node_id: int, partition_id: int) -> bytes:
    """Return a node's signature of the number it claims; ValueError if the file holds no key that can sign."""
    try:
        key = serialization.load_ssh_private_key(Path(private_key).read_bytes(), None)
    except (OSError, ValueError) as error:
        raise ValueError(f"{private_key} is not a private key of `fedvla credentials`: {error}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise ValueError(f"{private_key} is not a key of an elliptic curve, as `fedvla credentials` makes them")
    return key.sign(_claim(run_id, node_id, partition_id), ALGORITHM)


def proof(folder: Path, run_id: int) -> Proof:
    """Return the check of signatures with the public keys of a folder, ``node_3.pub`` for number 3.

    Raises:
        ValueError: there are no such keys in the folder.
    """
    if not list(folder.glob("node_*.pub")):
        raise ValueError(f"node-keys={str(folder)!r} has no node_K.pub: give the folder `fedvla credentials` wrote")

    def check(node_id: int, partition_id: int, signature: object) -> None:
        file = folder / f"node_{partition_id}.pub"
        if not file.is_file():
            raise ParameterError("key", f"partition-id={partition_id}: there is no {file.name} to check it with")
        key = serialization.load_ssh_public_key(file.read_bytes())
        try:
            if not isinstance(signature, bytes):
                raise InvalidSignature
            key.verify(signature, _claim(run_id, node_id, partition_id), ALGORITHM)
        except InvalidSignature as error:
            text = f"node {node_id} claims partition-id={partition_id} without a signature by the key {file.name}"
            raise ParameterError("key", text) from error

    return check


def _claim(run_id: int, node_id: int, partition_id: int) -> bytes:
    return f"fedvla run {run_id} node {node_id} partition {partition_id}".encode()
