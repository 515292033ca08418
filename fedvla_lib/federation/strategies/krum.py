"""Krum: the one client's model that lies closest to the others."""

from flwr.serverapp.strategy import Krum

from fedvla_lib.federation.strategies.checked import Checked


class CheckedKrum(Checked, Krum):
    """The one model that lies closest to the others (Blanchard et al. 2017, https://arxiv.org/abs/1703.02757)."""
