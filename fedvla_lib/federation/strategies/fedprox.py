"""FedProx: FedAvg whose clients are pulled towards the global model; the client side."""

from collections.abc import Mapping

import torch

from fedvla_lib.policy.training import Parameters, with_gradient


class Proximal:
    """FedProx's pull towards the global model: the gradient of mu / 2 ||w - w_global||^2.

    Li et al. 2020, Federated Optimization in Heterogeneous Networks, https://arxiv.org/abs/1812.06127.

    Args:
        anchor: the global model's parameters by name; they are copied, because the live parameters change in training.
        mu: weight of the term; with 0 the result is that of FedAvg, bit for bit.
    """

    def __init__(self, anchor: Mapping[str, torch.Tensor], mu: float) -> None:
        self._anchor = {name: tensor.detach().clone() for name, tensor in anchor.items()}
        self._mu = mu

    def __call__(self, parameters: Parameters) -> None:
        """Add mu (w - w_global)."""
        if self._mu:
            for name, parameter in with_gradient(parameters, self._anchor):
                parameter.grad.add_(parameter.detach() - self._anchor[name], alpha=self._mu)
