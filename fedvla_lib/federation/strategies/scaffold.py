"""SCAFFOLD: control variates correct the clients' gradients; client side and server side."""

from typing import Any

import numpy as np
import torch
from flwr.serverapp.strategy import FedAvg

from fedvla_lib.federation import messages
from fedvla_lib.federation.strategies.checked import Checked
from fedvla_lib.policy.parameters import Arrays
from fedvla_lib.policy.training import Parameters, with_gradient


class ControlVariates:
    """SCAFFOLD's correction: each gradient g_k becomes g_k - c_k + c.

    c_k estimates the client's gradient and c the mean gradient of all clients. Karimireddy et al. 2020,
    https://arxiv.org/abs/1910.06378, Algorithm 1. With plain SGD, the paper's option II for the new c_k,
    c_k - c + (x - y_K) / (K eta), is the mean of the K gradients before correction; that mean is used here, because it
    does not depend on the optimiser.

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
        """Accumulate the gradients, then add c - c_k to them."""
        self._steps += 1
        for name, parameter in with_gradient(parameters, self._shift):
            gradient = parameter.grad
            self._sum[name] = self._sum[name] + gradient if name in self._sum else gradient.clone()
            gradient.add_(self._shift[name].to(gradient.device))

    def updated(self) -> Arrays:
        """Return the new c_k: the mean of the gradients before correction."""
        zeros = {name: np.zeros_like(array) for name, array in self._own.items()}
        return zeros | {name: (total / self._steps).cpu().numpy() for name, total in self._sum.items()}

    def change(self) -> Arrays:
        """Return the new c_k minus the old one, which the server adds to c."""
        return {name: array - self._own[name] for name, array in self.updated().items()}


class CheckedScaffold(Checked, FedAvg):
    """SCAFFOLD (Karimireddy et al. 2020, https://arxiv.org/abs/1910.06378): FedAvg with control variates.

    The server keeps c = sum_k p_k c_k over all clients and sends it with the model; `ControlVariates` is the client
    side. The paper weights clients equally; here p_k = n_k / sum n over all clients, sampled or not, as in averaging,
    because otherwise the optimum of the averaged loss would not be a fixed point.
    """

    _extra_records = (messages.CONTROL,)

    def __init__(self, **checked: Any) -> None:
        super().__init__(**checked)
        self.control: Arrays = {name: np.zeros(shape, np.float32) for name, shape in self.shapes.items()}

    def _combined(self, record: str, arrived: dict[int, Arrays]) -> Arrays:
        """Add the clients' changes to c."""
        if record != messages.CONTROL:
            return super()._combined(record, arrived)
        total, control = sum(map(self.roster.weight, self.roster.nodes)), self.control
        for node, change in arrived.items():
            weight = np.float32(self.roster.weight(node) / total)
            control = {name: array + weight * change[name] for name, array in control.items()}
        return control
