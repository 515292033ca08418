"""Secure aggregation without Flower's messages: the server learns the sum of the clients' vectors and nothing else.

The protocol of Bonawitz et al. 2017 (https://eprint.iacr.org/2017/281) on the sparse graph of Bell et al. 2020
(SecAgg+, https://eprint.iacr.org/2020/704), against a server that follows it and is curious. A client's vector of whole
numbers modulo 2^32 is covered by a mask of its own and by one for each neighbour, which the neighbour subtracts. Shamir
shares at the neighbours make up for clients that drop out: of a client that answered, the seed of its own mask is put
together, and of one that did not, the key of the other masks, never both.

Key agreement, shares and encryption are Flower's. The masks are not: Flower's generator has a seed of 32 bits.
"""

import base64
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from random import SystemRandom

import numpy as np
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.fernet import InvalidToken
from cryptography.hazmat.primitives.asymmetric.ec import SECP384R1
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
from flwr.common.secure_aggregation.crypto.shamir import combine_shares, create_shares
from flwr.common.secure_aggregation.crypto.symmetric_encryption import decrypt, encrypt, generate_shared_key
from flwr.common.secure_aggregation.secaggplus_utils import share_keys_plaintext_concat, share_keys_plaintext_separate
from flwr.supercore.primitives.asymmetric import (
    bytes_to_private_key,
    bytes_to_public_key,
    generate_key_pairs,
    private_key_to_bytes,
    public_key_to_bytes,
)

from fedvla_lib.config import Config, sample_size

LEAST_CLIENTS = 3  # in a round: of two, each knows the other's vector from the sum
MOST_NEIGHBOURS = 20  # of a client; with fewer clients, everyone is everyone's neighbour
HALF = 2**31  # a sum lies between -HALF and HALF, as steps of the grid
NOISED_LIMIT = 2**16  # of a client, with noise: NumPy draws Poisson numbers wrongly if their mean is 1e14 or more
TAIL = 12  # standard deviations of noise for which there is room
Public = tuple[bytes, bytes]  # of a client: its keys for encryption and for masks


@dataclass(frozen=True)
class Secrets:
    """What a client keeps for itself in a round: two private keys, and the seed of its own mask (32 bytes)."""

    encryption: bytes
    masking: bytes
    seed: bytes


@dataclass(frozen=True)
class Grid:
    """Whole numbers for real ones. `limit`: the largest one of a client, the clipping norm, in steps."""

    step: float
    limit: float

    def round(self, vector: np.ndarray) -> np.ndarray:
        """Return the nearest steps, int64."""
        return np.rint(vector / self.step).astype(np.int64)

    def real(self, total: np.ndarray) -> np.ndarray:
        """Return a sum modulo 2^32, uint32, as real numbers, float64."""
        return total.astype(np.uint32).view(np.int32) * self.step


def grid_for(config: Config) -> Grid:
    """Return the finest grid on which the sum of a round's clients, with their noise, stays below 2^31 steps."""
    clients = sample_size(config.fraction_train, config.num_clients)
    parts = {"server": 0, "client": clients, "together": clients / least_survivors(clients)}[config.noise_by]
    room = config.clip_norm * (clients + TAIL * config.noise * math.sqrt(parts))
    step = room / (HALF - clients)
    if config.noise_by == "together":
        step = max(step, config.clip_norm / NOISED_LIMIT)
    return Grid(step, config.clip_norm / step)


def least_survivors(clients: int) -> int:
    """Return how many clients of a round have to answer to the end, so that their sum can be read."""
    near = min(clients - 1, MOST_NEIGHBOURS)
    return max(threshold(near) + 1, clients // 2 + 1)  # a client's secrets are with its neighbours, not with itself


def share_of_noise(config: Config, size: int, rng: np.random.Generator) -> np.ndarray:
    """Return one client's part of the noise, int64: Skellam, the difference of two Poisson numbers.

    The parts of `least_survivors` have the variance (noise * limit)^2 together; those of more clients have more.
    """
    clients = sample_size(config.fraction_train, config.num_clients)
    mean = (config.noise * grid_for(config).limit) ** 2 / least_survivors(clients) / 2
    return rng.poisson(mean, size) - rng.poisson(mean, size)


def neighbours(clients: Sequence[int], most: int = MOST_NEIGHBOURS) -> dict[int, list[int]]:
    """Return each client's neighbours: all others, or the nearest ones on a ring in random order."""
    ring = SystemRandom().sample(list(clients), len(clients))
    reach = min(most // 2, (len(ring) - 1) / 2)
    sides = [k for k in range(-math.ceil(reach), math.ceil(reach) + 1) if k]
    return {one: sorted({ring[(i + k) % len(ring)] for k in sides} - {one}) for i, one in enumerate(ring)}


def threshold(count: int) -> int:
    """Return how many of a client's `count` neighbours have to give their share."""
    return count // 2 + 1


def new_secrets() -> Secrets:
    """Return fresh secrets, from the system's entropy."""
    encryption, masking = (private_key_to_bytes(generate_key_pairs()[0]) for _ in range(2))
    return Secrets(encryption, masking, os.urandom(32))


def is_public(keys: Public) -> bool:
    """Return whether these are two public keys on the curve of the protocol."""
    try:
        return all(isinstance(bytes_to_public_key(key).curve, SECP384R1) for key in keys)
    except (ValueError, TypeError, AttributeError, UnsupportedAlgorithm):
        return False


def public(secrets: Secrets) -> Public:
    """Return the public halves of a client's keys."""
    keys = (bytes_to_private_key(key).public_key() for key in (secrets.encryption, secrets.masking))
    return tuple(public_key_to_bytes(key) for key in keys)


def deal(secrets: Secrets, me: int, peers: dict[int, Public]) -> dict[int, bytes]:
    """Return, for each neighbour, its shares of the seed and of the masking key, for its eyes only."""
    needed = threshold(len(peers))
    seeds, keys = (create_shares(secret, needed, len(peers)) for secret in (secrets.seed, secrets.masking))
    shares = zip(sorted(peers), seeds, keys, strict=True)
    return {
        other: encrypt(_agreed(secrets.encryption, peers[other][0]), share_keys_plaintext_concat(me, other, seed, key))
        for other, seed, key in shares
    }


def opened(encryption: bytes, me: int, other: int, peer: Public, dealt: bytes) -> tuple[bytes, bytes] | None:
    """Return the shares of another client's seed and masking key; None if they are not whole, and from it to me.

    Args:
        encryption: this client's private key.
    """
    try:
        sender, receiver, seed, key = share_keys_plaintext_separate(decrypt(_agreed(encryption, peer[0]), dealt))
    except InvalidToken:
        return None
    return (seed, key) if (sender, receiver) == (other, me) else None


def masked(vector: np.ndarray, secrets: Secrets, me: int, peers: dict[int, Public]) -> np.ndarray:
    """Return whole numbers under masks, uint32 modulo 2^32: uniform for all who do not know the masks."""
    covered = vector.astype(np.uint32) + _stream(secrets.seed, len(vector))
    for other, peer in peers.items():
        covered = _shifted(covered, _pair_mask(secrets.masking, peer[1], len(vector)), me < other)
    return covered


def unmasked(
    total: np.ndarray, seeds: Iterable[bytes], lost: dict[int, bytes], keys: dict[int, Public],
    pairs: dict[int, list[int]],
) -> np.ndarray:  # fmt: skip
    """Take the masks off a sum of masked vectors, uint32.

    Args:
        seeds: of the clients in the sum.
        lost: masking keys of clients that dealt shares and are not in the sum.
        keys: public keys by client.
        pairs: for each lost client, those in the sum that used a mask shared with it.
    """
    for seed in seeds:
        total = total - _stream(seed, len(total))
    for client, key in lost.items():
        for other in pairs[client]:
            total = _shifted(total, _pair_mask(key, keys[other][1], len(total)), client < other)
    return total


def combined(shares: Sequence[bytes]) -> bytes:
    """Return the secret of a client from enough of its shares."""
    return combine_shares(list(shares))


def _shifted(vector: np.ndarray, mask: np.ndarray, adds: bool) -> np.ndarray:
    return vector + mask if adds else vector - mask


def _pair_mask(private: bytes, other: bytes, size: int) -> np.ndarray:
    return _stream(base64.urlsafe_b64decode(_agreed(private, other)), size)


def _agreed(private: bytes, other: bytes) -> bytes:
    """The key that two clients share, each from its private and the other's public key."""
    return generate_shared_key(bytes_to_private_key(private), bytes_to_public_key(other))


def _stream(key: bytes, size: int) -> np.ndarray:
    """Uniform uint32 numbers from a key of 256 bits, used once: AES in counter mode."""
    cipher = Cipher(algorithms.AES(key), modes.CTR(bytes(16)))
    return np.frombuffer(cipher.encryptor().update(bytes(4 * size)), dtype="<u4")
