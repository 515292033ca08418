"""Choose the strategy by the settings: one of Flower's with the checks of `Checked`, or one that Flower lacks."""

from typing import Any

from flwr.serverapp.strategy import FedAdam, FedAvg, FedAvgM, FedMedian, FedProx, FedYogi, Krum

from fedvla_lib.config import Config
from fedvla_lib.federation.strategies.checked import Checked
from fedvla_lib.federation.strategies.outer_steps import DiLoCo, FedExP
from fedvla_lib.federation.strategies.scaffold import CheckedScaffold

# Default server learning rates for pretrained weights. With Flower's 0.1, a round can change each weight by 0.1,
# which is as much as the weights themselves.
SERVER_LR = {"fedavgm": 1.0, "fedadam": 0.01, "fedyogi": 0.01, "diloco": 0.7}
ADAPTIVITY = 1e-3  # tau: added to the root of the second moment


def build_strategy(config: Config, **checked: Any) -> Checked:
    """Return the strategy that the settings name.

    Args:
        **checked: the other arguments of `Checked`.
    """
    rate = config.server_lr or SERVER_LR.get(config.strategy, 1.0)
    strategy, options = {
        # sum_k n_k w_k / sum_k n_k with n_k the training frames of client k
        # (McMahan et al. 2017, https://arxiv.org/abs/1602.05629)
        "fedavg": (FedAvg, {}),
        # the clients add mu / 2 ||w - w_global||^2 to their loss, see `fedprox`
        # (Li et al. 2020, https://arxiv.org/abs/1812.06127)
        "fedprox": (FedProx, {"proximal_mu": config.proximal_mu}),
        # momentum on the server (Hsu et al. 2019, https://arxiv.org/abs/1909.06335)
        "fedavgm": (FedAvgM, {"server_learning_rate": rate, "server_momentum": config.server_momentum}),
        # Adam on the server, the averaged update as its gradient (Reddi et al. 2021, https://arxiv.org/abs/2003.00295)
        "fedadam": (FedAdam, {"eta": rate, "tau": ADAPTIVITY}),
        # Yogi: the same with a second moment that grows more slowly (Reddi et al. 2021, same paper)
        "fedyogi": (FedYogi, {"eta": rate, "tau": ADAPTIVITY}),
        # a Nesterov step along the averaged update (Douillard et al. 2023, https://arxiv.org/abs/2311.08105)
        "diloco": (DiLoCo, {"server_learning_rate": rate, "server_momentum": config.server_momentum}),
        # a longer step if the updates disagree more (Jhunjhunwala et al. 2023, https://arxiv.org/abs/2301.09604)
        "fedexp": (FedExP, {}),
        # the median of each coordinate, every client counting alike (Yin et al. 2018, https://arxiv.org/abs/1803.01498)
        "fedmedian": (FedMedian, {}),
        # the one model that lies closest to the others (Blanchard et al. 2017, https://arxiv.org/abs/1703.02757)
        "krum": (Krum, {"num_malicious_nodes": config.num_malicious}),
        "scaffold": (CheckedScaffold, {}),
    }[config.strategy]
    if not issubclass(strategy, Checked):
        strategy = type(f"Checked{strategy.__name__}", (Checked, strategy), {})
    return strategy(config=config, **options, **checked)
