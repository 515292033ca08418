"""How much privacy a run has spent: epsilon at a delta, for one client's whole part in it.

Neighbouring runs differ in one client's payloads, which are replaced by zeros in all rounds. Renyi differential privacy
adds up over rounds and is converted at the end, by the library dp-accounting.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypedDict

import numpy as np
from scipy.optimize import brentq

from fedvla_lib import files
from fedvla_lib.config import Config, sample_size
from fedvla_lib.federation import privacy, secure_aggregation

SPENT_FILE = "privacy.json"  # in a run folder: never goes back, unlike the metrics of a run that is resumed
MOST_NOISE = 1e6


class Spent(TypedDict):
    """What is read from `SPENT_FILE`."""

    releases: int


class BudgetSpent(RuntimeError):
    """Another round would exceed `epsilon-budget`."""


def delta(config: Config) -> float:
    """Return `config.delta`, or num_clients^-1.1 if it is 0."""
    return config.delta or config.num_clients**-1.1


def epsilon(config: Config, releases: int, size: int) -> float:
    """Return epsilon after some releases, whoever sees who takes part in a round.

    Args:
        size: how many numbers a client sends; matters only for noise that the clients add together.
    """
    import dp_accounting  # takes a second to import, and few runs need it
    from dp_accounting import rdp

    if not releases:
        return 0.0
    accountant = rdp.RdpAccountant()
    if config.noise_by == "together":
        orders = np.arange(2, 512)  # the bound holds for whole orders
        spent = releases * skellam_rdp(orders, config.noise, secure_aggregation.grid_for(config).limit, size)
        return float(rdp.compute_epsilon(orders, spent, delta(config))[0])
    event = dp_accounting.GaussianDpEvent(config.noise)
    accountant.compose(event, releases)
    return float(accountant.get_epsilon(delta(config)))


def epsilon_sampled(config: Config, releases: int, clients: int) -> float:
    """Return epsilon against those who see only the models, if who took part in which round stays secret.

    Sampling without replacement amplifies privacy (Wang et al. 2019, https://arxiv.org/abs/1808.00087). The theorem is
    about replacing one client by another, which moves the sum by up to 2 C.

    Args:
        clients: those that the rounds are drawn from.
    """
    import dp_accounting
    from dp_accounting import rdp

    accountant = rdp.RdpAccountant(neighboring_relation=dp_accounting.NeighboringRelation.REPLACE_ONE)
    drawn = sample_size(config.fraction_train, clients)
    gaussian = dp_accounting.GaussianDpEvent(config.noise / 2)
    accountant.compose(dp_accounting.SampledWithoutReplacementDpEvent(clients, drawn, gaussian), releases)
    return float(accountant.get_epsilon(delta(config)))


def skellam_rdp(orders: np.ndarray, noise: float, limit: float, size: int) -> np.ndarray:
    """Return the Renyi divergences of one release of a sum of whole numbers with Skellam noise.

    Agarwal et al. 2021, https://arxiv.org/abs/2110.04995, theorem 3.5, for variance m and sensitivities D1 and D2:
    a D2^2 / 2m + min(((2a - 1) D2^2 + 6 D1) / 4m^2, 3 D1 / 2m). Rounding lengthens a vector by sqrt(size) / 2 at most.

    Args:
        noise: noise multiplier.
        limit: the clipping norm, in steps of the grid.
        size: numbers in the vector.
    """
    variance, second = (noise * limit) ** 2, limit + math.sqrt(size) / 2
    first = min(math.sqrt(size) * second, second**2)
    rest = np.minimum(((2 * orders - 1) * second**2 + 6 * first) / (4 * variance**2), 3 * first / (2 * variance))
    return orders * second**2 / (2 * variance) + rest


def check_budget(config: Config, size: int) -> None:
    """Raise ValueError, naming the noise or the rounds that would do, if a whole run would exceed its budget."""
    rounds, budget = config.num_server_rounds, config.epsilon_budget
    if not budget or (needed := epsilon(config, rounds, size)) <= budget:
        return
    fits = [number for number in range(rounds) if epsilon(config, number, size) <= budget]
    over = lambda log: epsilon(replace(config, noise=math.exp(log)), rounds, size) - budget  # noqa: E731
    enough = math.exp(brentq(over, math.log(config.noise), math.log(MOST_NOISE), xtol=1e-3))
    raise ValueError(
        f"epsilon-budget={budget:g} is not enough: {rounds} rounds with noise={config.noise:g} give epsilon "
        f"{needed:.3g} at delta {delta(config):.2g}: give noise={enough * 1.005:.3g}, or num-server-rounds={max(fits)}"
    )


def open_ledger(config: Config, root: Path, size: int, clients: int) -> "Ledger":
    """Return the ledger of a run whose clients send `size` numbers; raise ValueError if its budget is too small."""
    check_budget(config, size)
    return Ledger(config, root, size, clients)


@dataclass(frozen=True)
class Ledger:
    """Counts a run's releases in its folder. A round that is repeated after a crash counts twice.

    What it counts covers the models that leave the server, or with noise of the clients the updates that reach it. The
    run folder itself has losses and norms without noise: it stays where it is.
    """

    config: Config
    root: Path
    size: int  # numbers that a client sends
    clients: int  # that the rounds are drawn from

    def spend(self) -> dict[str, float]:
        """Count one more release, before it happens, and return what has been spent with it.

        Raises:
            BudgetSpent: it would exceed the budget.
        """
        file = self.root / SPENT_FILE
        count = 1 + (files.read_json(file, Spent)["releases"] if file.is_file() else 0)
        spent, budget = epsilon(self.config, count, self.size), self.config.epsilon_budget
        if budget and spent > budget:
            raise BudgetSpent(f"release {count} would make epsilon {spent:.3g}, more than epsilon-budget={budget:g}")
        values = {"releases": count, "epsilon": spent, "delta": delta(self.config), "secret": self.config.secret_noise}
        if privacy.hides_sampling(self.config):
            values["epsilon_sampled"] = epsilon_sampled(self.config, count, self.clients)
        files.write_json(file, values)
        return values
