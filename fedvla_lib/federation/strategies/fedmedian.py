"""FedMedian: the median of each coordinate over the clients."""

from flwr.serverapp.strategy import FedMedian

from fedvla_lib.federation.strategies.checked import Checked


class CheckedFedMedian(Checked, FedMedian):
    """The median of each coordinate, every client counting alike (Yin et al. 2018, https://arxiv.org/abs/1803.01498)."""
