"""FedYogi: Yogi on the server, with the averaged update as its gradient."""

from flwr.serverapp.strategy import FedYogi

from fedvla_lib.federation.strategies.checked import Checked


class CheckedFedYogi(Checked, FedYogi):
    """Yogi on the server: as FedAdam, with a second moment that grows more slowly (https://arxiv.org/abs/2003.00295)."""

    _persistent = ("m_t", "v_t")
