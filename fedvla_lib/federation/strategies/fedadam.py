"""FedAdam: Adam on the server, with the averaged update as its gradient."""

from flwr.serverapp.strategy import FedAdam

from fedvla_lib.federation.strategies.checked import Checked


class CheckedFedAdam(Checked, FedAdam):
    """Adam on the server, the averaged update as its gradient (Reddi et al. 2021, https://arxiv.org/abs/2003.00295)."""

    _persistent = ("m_t", "v_t")
