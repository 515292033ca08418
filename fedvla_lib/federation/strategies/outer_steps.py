"""Strategies whose server steps along u = sum_k p_k u_k, the mean of the clients' updates: DiLoCo and FedExP.

They are Flower strategies like Flower's own; p_k = n_k / sum n, as in FedAvg.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from flwr.app import ArrayRecord, ConfigRecord, Message, MetricRecord
from flwr.serverapp import Grid
from flwr.serverapp.strategy import FedAvg

from fedvla_lib.federation import messages
from fedvla_lib.policy.parameters import Arrays

EPSILON = 1e-3  # FedExP: added to the squared norm of the mean update


class OuterStep(FedAvg):
    """FedAvg that replaces the mean update by `step` of it."""

    def configure_train(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """Keep the global arrays, relative to which updates are taken."""
        self.start_of_round = messages.unpack_arrays(arrays)
        return super().configure_train(server_round, arrays, config, grid)

    def aggregate_train(
        self, server_round: int, replies: Iterable[Message]
    ) -> tuple[ArrayRecord | None, MetricRecord | None]:
        """Average as FedAvg does, then take the step."""
        replies = list(replies)
        mean, metrics = super().aggregate_train(server_round, replies)
        step = self.step(self._update(mean), replies)
        return messages.pack_arrays({name: start + step[name] for name, start in self.start_of_round.items()}), metrics

    def step(self, update: Arrays, replies: list[Message]) -> Arrays:
        """Return what to add to the global arrays."""
        raise NotImplementedError

    def _update(self, end: ArrayRecord) -> Arrays:
        return {name: end[name].numpy() - start for name, start in self.start_of_round.items()}


class DiLoCo(OuterStep):
    """A Nesterov step: m <- b m + u, w <- w + eta (u + b m).

    Douillard et al. 2023, https://arxiv.org/abs/2311.08105, who use eta = 0.7 and b = 0.9, and AdamW on the clients.
    """

    def __init__(self, *, server_learning_rate: float, server_momentum: float, **flower: Any) -> None:
        super().__init__(**flower)
        self.rate, self.momentum = np.float32(server_learning_rate), np.float32(server_momentum)
        self.momentum_vector: Arrays = {}

    def step(self, update: Arrays, replies: list[Message]) -> Arrays:
        """Update m and return eta (u + b m)."""
        old = self.momentum_vector or {name: np.zeros_like(array) for name, array in update.items()}
        self.momentum_vector = {name: self.momentum * old[name] + array for name, array in update.items()}
        return {name: self.rate * (u + self.momentum * self.momentum_vector[name]) for name, u in update.items()}


class FedExP(OuterStep):
    """A longer step if the updates differ more: eta = max(1, sum_k p_k ||u_k||^2 / (2 (||u||^2 + epsilon))).

    Jhunjhunwala et al. 2023, https://arxiv.org/abs/2301.09604, with equal p_k.
    """

    def step(self, update: Arrays, replies: list[Message]) -> Arrays:
        """Return eta u."""
        squares = [_square(self._update(reply.content[messages.ARRAYS])) for reply in replies]
        weights = [reply.content[messages.METRICS][messages.EXAMPLES] for reply in replies]
        rate = max(1.0, np.average(squares, weights=weights) / (2 * (_square(update) + EPSILON)))
        return {name: np.float32(rate) * array for name, array in update.items()}


def _square(arrays: Arrays) -> float:
    return sum(float(np.square(array, dtype=np.float64).sum()) for array in arrays.values())
