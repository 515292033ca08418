"""FedAvgM: FedAvg with momentum on the server."""

from flwr.serverapp.strategy import FedAvgM

from fedvla_lib.federation.strategies.checked import Checked


class CheckedFedAvgM(Checked, FedAvgM):
    """FedAvg with momentum on the server (Hsu et al. 2019, https://arxiv.org/abs/1909.06335)."""

    _persistent = ("momentum_vector",)
