"""Choose the strategy by the settings."""

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

# Default server learning rates for pretrained weights. With Flower's 0.1, a round can change each weight by 0.1,
# which is as much as the weights themselves.
SERVER_LR = {"fedavgm": 1.0, "fedadam": 0.01, "fedyogi": 0.01}
ADAPTIVITY = 1e-3  # tau: added to the root of the second moment


def build_strategy(config: Config, weights: dict[int, float], **checked: Any) -> Checked:
    """Return the strategy that the settings name.

    Args:
        weights: each node's share of all training frames.
        **checked: the other arguments of `Checked`.
    """
    rate = config.server_lr or SERVER_LR.get(config.strategy, 1.0)
    strategy, options = {
        "fedavg": (CheckedFedAvg, {}),
        "fedprox": (CheckedFedProx, {"proximal_mu": config.proximal_mu}),
        "fedavgm": (CheckedFedAvgM, {"server_learning_rate": rate, "server_momentum": config.server_momentum}),
        "fedadam": (CheckedFedAdam, {"eta": rate, "tau": ADAPTIVITY}),
        "fedyogi": (CheckedFedYogi, {"eta": rate, "tau": ADAPTIVITY}),
        "fedmedian": (CheckedFedMedian, {}),
        "krum": (CheckedKrum, {"num_malicious_nodes": config.num_malicious}),
        "scaffold": (CheckedScaffold, {"weights": weights}),
    }[config.strategy]
    return strategy(config=config, **options, **checked)
