"""FedAvg: the mean of the clients' arrays, weighted by their training frames."""

from flwr.serverapp.strategy import FedAvg

from fedvla_lib.federation.strategies.checked import Checked


class CheckedFedAvg(Checked, FedAvg):
    """Flower's FedAvg (McMahan et al. 2017, https://arxiv.org/abs/1602.05629) on checked replies.

    The new global array is sum_k n_k w_k / sum_k n_k with n_k the training frames of client k.
    """
