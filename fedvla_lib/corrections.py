"""What ties a client's local steps to the federation: terms added to its gradients after each backward pass."""

from collections.abc import Container, Mapping
from typing import Protocol

import numpy as np
import torch

from fedvla_lib.params import Arrays

Parameters = Mapping[str, torch.nn.Parameter]


class Correction(Protocol):
    """Called after each backward pass, before clipping, with the trainable parameters by name."""

    def __call__(self, parameters: Parameters) -> None:
        """Change the gradients in place."""


class Proximal:
    """FedProx's pull towards the global model: the gradient of mu / 2 ||w - w_global||^2.

    Li et al. 2020, Federated Optimization in Heterogeneous Networks, https://arxiv.org/abs/1812.06127.

    Args:
        anchor: the parameters as the global model has them, by name. They are copied: an anchor that is the live
            weights themselves moves along and pulls nowhere.
        mu: weight of the term; with 0 nothing is added, which leaves FedAvg to the last bit.
    """

    def __init__(self, anchor: Mapping[str, torch.Tensor], mu: float) -> None:
        self._anchor = {name: tensor.detach().clone() for name, tensor in anchor.items()}
        self._mu = mu

    def __call__(self, parameters: Parameters) -> None:
        """Add mu (w - w_global)."""
        if self._mu:
            for name, parameter in _with_gradient(parameters, self._anchor):
                parameter.grad.add_(parameter.detach() - self._anchor[name], alpha=self._mu)


class ControlVariates:
    """SCAFFOLD's correction: each gradient g_k becomes g_k - c_k + c.

    c_k estimates the client's gradient and c that of all clients, so the corrected step goes where all clients together
    want to go. Karimireddy et al. 2020, https://arxiv.org/abs/1910.06378, Algorithm 1. The paper's option II for the
    new c_k, c_k - c + (x - y_K) / (K eta), is under plain SGD the mean of the K gradients before correction; that mean
    is what is used here, because it means the same whatever optimiser turns gradients into steps.

    Args:
        server: c by name, float32.
        own: c_k by name, float32; empty in the client's first round, where c_k = 0.
    """

    def __init__(self, server: Arrays, own: Arrays) -> None:
        self._own = own or {name: np.zeros_like(array) for name, array in server.items()}
        self._shift = {name: torch.from_numpy(server[name] - self._own[name]) for name in server}
        self._sum: dict[str, torch.Tensor] = {}
        self._steps = 0

    def __call__(self, parameters: Parameters) -> None:
        """Remember the gradients, then add c - c_k to them."""
        self._steps += 1
        for name, parameter in _with_gradient(parameters, self._shift):
            gradient = parameter.grad
            self._sum[name] = self._sum[name] + gradient if name in self._sum else gradient.clone()
            gradient.add_(self._shift[name].to(gradient.device))

    def own_after(self) -> Arrays:
        """Return the new c_k: the mean of the gradients seen, as they were before correction."""
        zeros = {name: np.zeros_like(array) for name, array in self._own.items()}
        return zeros | {name: (total / self._steps).cpu().numpy() for name, total in self._sum.items()}

    def change(self) -> Arrays:
        """Return new c_k minus old c_k: what the server adds up."""
        return {name: array - self._own[name] for name, array in self.own_after().items()}


def _with_gradient(parameters: Parameters, known: Container[str]) -> list[tuple[str, torch.nn.Parameter]]:
    """Parameters to correct: not those that a backward pass did not reach, nor those that stay with the client."""
    return [(name, p) for name, p in parameters.items() if p.grad is not None and name in known]
