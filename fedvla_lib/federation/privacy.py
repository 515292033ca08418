"""Client-level differential privacy: one client's contribution to a round is clipped, and Gaussian noise covers it.

What a client contributes is its payload: the change of the weights, and whatever else the strategy asks for, clipped
together to one L2 norm C. The noise on the sum of the payloads has standard deviation z C, with z = `Config.noise`
(McMahan et al. 2018, https://arxiv.org/abs/1710.06963). Who adds it decides who is trusted: the server, nobody (each
client adds all of it), or the clients together (each adds a part, under secure aggregation). All clients count alike:
a weight by frames would let one client count for more than C.
"""

import math
from collections.abc import Sequence

import numpy as np

from fedvla_lib.config import Config
from fedvla_lib.policy.parameters import Arrays

Payload = dict[str, Arrays]  # by record, then by name
RATE = 0.2  # of the adaptive clipping norm, and one client in `CLIENTS_PER_BIT` of noise on the count: Andrew et al.
CLIENTS_PER_BIT = 20
SERVER_NOISE, COUNT_NOISE, CLIENT_NOISE = 10, 11, 12  # purposes of random streams


def is_private(config: Config) -> bool:
    """Return whether noise protects the clients."""
    return config.noise > 0


def hides_updates(config: Config) -> bool:
    """Return whether the server, too, sees no client's own update."""
    return config.secure_aggregation or (is_private(config) and config.noise_by != "server")


def hides_sampling(config: Config) -> bool:
    """Return whether it stays secret who takes part in a round, and a reply tells nothing of earlier rounds."""
    drawn = config.secret_noise and config.noise_by == "server" and config.sampling == "uniform"
    keeps = config.keep_optimizer or config.personal or config.strategy == "scaffold" or config.exchange != "float32"
    return drawn and config.fraction_train < 1 and not keeps


def weighs_alike(config: Config) -> bool:
    """Return whether all clients count alike, and not by their frames."""
    return is_private(config) or config.secure_aggregation


def source(config: Config, *key: int) -> np.random.Generator:
    """Return the random generator for noise, and for who takes part: from the system if secret, else the seed.

    Noise from a seed that others know can be subtracted again: it is for experiments.
    """
    return np.random.default_rng(None if config.secret_noise else [config.seed, *key])


def norm(payload: Payload) -> float:
    """Return the L2 norm over all numbers of a payload."""
    squares = (np.square(array, dtype=np.float64).sum() for arrays in payload.values() for array in arrays.values())
    return math.sqrt(sum(squares))


def clipped(payload: Payload, limit: float) -> Payload:
    """Scale a payload down to the L2 norm `limit`; shorter ones stay as they are, one that is not finite becomes 0."""
    length = norm(payload)
    if not math.isfinite(length):
        return {record: {n: np.zeros_like(a) for n, a in arrays.items()} for record, arrays in payload.items()}
    return scaled(payload, limit / length) if length > limit else payload


def scaled(payload: Payload, factor: float) -> Payload:
    """Return the payload times a number."""
    rate = np.float32(factor)
    return {record: {name: rate * array for name, array in arrays.items()} for record, arrays in payload.items()}


def noisy(payload: Payload, deviation: float, rng: np.random.Generator) -> Payload:
    """Add Gaussian noise of this standard deviation to each number."""
    return {
        record: {n: (a + rng.normal(0, deviation, np.shape(a))).astype(np.float32) for n, a in arrays.items()}
        for record, arrays in payload.items()
    }


def total(payloads: Sequence[Payload]) -> Payload:
    """Return the sum of payloads, added up in float64."""
    return {
        record: {name: np.sum([one[record][name] for one in payloads], axis=0, dtype=np.float64) for name in arrays}
        for record, arrays in payloads[0].items()
    }


def noised_mean(payloads: Sequence[Payload], deviation: float, rng: np.random.Generator) -> Payload:
    """Return the mean of payloads, with noise of this standard deviation on their sum."""
    return scaled(noisy(total(payloads), deviation, rng), 1 / len(payloads))


def from_client(payload: Payload, config: Config, round_number: int, partition_id: int) -> Payload:
    """Return what a client sends that does not trust the server: clipped, with all of the noise if it adds it alone."""
    payload = clipped(payload, config.clip_norm)
    if not is_private(config) or config.noise_by != "client":
        return payload
    rng = source(config, round_number, CLIENT_NOISE, partition_id)
    return noisy(payload, config.noise * config.clip_norm, rng)


def count_noise(noise: float, num_clients: int) -> float:
    """Return the standard deviation of the noise on the number of clients that were not clipped."""
    return max(num_clients / CLIENTS_PER_BIT, 2 * noise)


def noise_beside_count(noise: float, num_clients: int) -> float:
    """Return the noise multiplier for the sum, so that sum and count together are as private as `noise` says.

    (z^-2 - s^-2)^(-1/2), s being the noise on the count. Theorem 1 of Andrew et al. 2021 has 2 s for s, since there a
    client that is left out moves the count by 1/2 (https://arxiv.org/abs/1905.03871). One replaced by zeros: by 1.
    """
    return (noise**-2 - count_noise(noise, num_clients) ** -2) ** -0.5


def adapted(limit: float, norms: Sequence[float], config: Config, rng: np.random.Generator) -> float:
    """Return the next round's clipping norm, nearer to the quantile `clip_quantile` of the clients' norms.

    C <- C exp(-0.2 (b - q)), b being the share of clients that were not clipped, noised (Andrew et al. 2021).
    """
    unclipped = sum(length <= limit for length in norms)
    if is_private(config):
        unclipped += rng.normal(0, count_noise(config.noise, len(norms)))
    return limit * math.exp(-RATE * (unclipped / len(norms) - config.clip_quantile))
