"""Build the strategy that the settings name."""

from typing import Any

from fedvla_lib.config import Config
from fedvla_lib.federation.strategies.checked import Checked
from fedvla_lib.federation.strategies.fedadam import CheckedFedAdam
from fedvla_lib.federation.strategies.fedavg import CheckedFedAvg
from fedvla_lib.federation.strategies.fedavgm import CheckedFedAvgM
from fedvla_lib.federation.strategies.fedmedian import CheckedFedMedian
from fedvla_lib.federation.strategies.fedprox import CheckedFedProx
from fedvla_lib.federation.strategies.fedyogi import CheckedFedYogi
from fedvla_lib.federation.strategies.krum import CheckedKrum
from fedvla_lib.federation.strategies.scaffold import CheckedScaffold

# What a strategy takes for the step size of the server, for arrays that start from a pretrained model. Flower's default
# of 0.1 moves each weight by up to 0.1 a round, as far as these weights are from zero.
SERVER_LR = {"fedavgm": 1.0, "fedadam": 0.01, "fedyogi": 0.01}
ADAPTIVITY = 1e-3  # tau: added to the root of the second moment


def build_strategy(config: Config, weights: dict[int, float], **checked: Any) -> Checked:
    """Return the strategy that the settings name.

    Args:
        weights: each node's share of all training frames.
        **checked: what `Checked` takes.
    """
    rate = config.server_lr or SERVER_LR.get(config.strategy, 1.0)
    if config.strategy == "fedprox":
        return CheckedFedProx(proximal_mu=config.proximal_mu, **checked)
    if config.strategy == "fedavgm":
        return CheckedFedAvgM(server_learning_rate=rate, server_momentum=config.server_momentum, **checked)
    if config.strategy == "fedadam":
        return CheckedFedAdam(eta=rate, tau=ADAPTIVITY, **checked)
    if config.strategy == "fedyogi":
        return CheckedFedYogi(eta=rate, tau=ADAPTIVITY, **checked)
    if config.strategy == "krum":
        return CheckedKrum(num_malicious_nodes=config.num_malicious, **checked)
    if config.strategy == "scaffold":
        return CheckedScaffold(weights=weights, **checked)
    return {"fedavg": CheckedFedAvg, "fedmedian": CheckedFedMedian}[config.strategy](**checked)
