"""SCAFFOLD: control variates correct each client's gradients; the client's half and the server's."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from flwr.app import ArrayRecord, ConfigRecord, Message, MessageType, RecordDict
from flwr.serverapp import Grid
from flwr.serverapp.strategy import FedAvg

from fedvla_lib.federation import messages
from fedvla_lib.federation.strategies.checked import Checked
from fedvla_lib.policy.parameters import Arrays, digest
from fedvla_lib.policy.training import Parameters, with_gradient


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
        for name, parameter in with_gradient(parameters, self._shift):
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


class CheckedScaffold(Checked, FedAvg):
    """SCAFFOLD (Karimireddy et al. 2020, https://arxiv.org/abs/1910.06378): FedAvg with control variates.

    The server keeps c = sum_k p_k c_k over all clients and sends it along; `corrections.ControlVariates` is the half
    of a client. The paper weighs clients alike; here p_k = n_k / sum n, the weight that averaging gives a client,
    because with other weights the optimum of the averaged loss would not be a fixed point. With equal clients this is
    the paper's.

    Args:
        weights: p_k by node id, over all clients, whether drawn or not.
        **checked: what `Checked` takes.
    """

    _also = (messages.CONTROL,)
    _memory = ("control",)

    def __init__(self, *, weights: dict[int, float], **checked: Any) -> None:
        super().__init__(**checked)
        self.weights = weights
        self.control: Arrays = {name: np.zeros(shape, np.float32) for name, shape in self.shapes.items()}

    def configure_train(
        self, server_round: int, arrays: ArrayRecord, config: ConfigRecord, grid: Grid
    ) -> Iterable[Message]:
        """Announce the control variate's SHA-256 beside the arrays'."""
        config[messages.CONTROL_DIGEST] = digest(self.control)
        return super().configure_train(server_round, arrays, config, grid)

    def _construct_messages(self, record: RecordDict, node_ids: list[int], message_type: str) -> Iterable[Message]:
        if message_type == MessageType.TRAIN:
            record[messages.CONTROL] = messages.pack_arrays(self.control)
        return super()._construct_messages(record, node_ids, message_type)

    def _take(self, server_round: int, good: list[Message]) -> None:
        """Add the clients' changes to c, and leave in each reply what Flower averages."""
        for reply in good:
            change = messages.unpack_arrays(reply.content.pop(messages.CONTROL))
            weight = np.float32(self.weights[reply.metadata.src_node_id])
            self.control = {name: array + weight * change[name] for name, array in self.control.items()}
        super()._take(server_round, good)

    def _check_train(self, reply: Message) -> None:
        super()._check_train(reply)
        messages.checked_arrays(reply.content, messages.NOTE, self.shapes, messages.CONTROL, also=(messages.ARRAYS,))
