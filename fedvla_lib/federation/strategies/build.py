"""Choose the strategy by the settings: with the checks of `Checked` one of Flower's, one that it lacks, or yours."""

import importlib
import os
import sys
from typing import Any

from flwr.serverapp import strategy as flower
from flwr.serverapp.strategy import FedAdam, FedAvg, FedAvgM, FedMedian, FedProx, FedYogi, Krum, Strategy
from flwr.supercore.differential_privacy import KEY_NORM_BIT

from fedvla_lib.config import Config
from fedvla_lib.federation.strategies.checked import Checked
from fedvla_lib.federation.strategies.outer_steps import DiLoCo, FedExP
from fedvla_lib.federation.strategies.scaffold import CheckedScaffold

# Default server learning rates for pretrained weights. With Flower's 0.1, a round can change each weight by 0.1,
# which is as much as the weights themselves.
SERVER_LR = {"fedavgm": 1.0, "fedadam": 0.01, "fedyogi": 0.01, "diloco": 0.7}
ADD_NOISE = (
    flower.DifferentialPrivacyClientSideAdaptiveClipping, flower.DifferentialPrivacyClientSideFixedClipping,
    flower.DifferentialPrivacyServerSideAdaptiveClipping, flower.DifferentialPrivacyServerSideFixedClipping,
)  # fmt: skip
ADAPTIVITY = 1e-3  # tau: added to the root of the second moment


def build_strategy(config: Config, **checked: Any) -> Checked:
    """Return the strategy that the settings name.

    Args:
        **checked: the other arguments of `Checked`.
    """
    if ":" in config.strategy:
        return _checked(brought(config.strategy))(config=config, **checked)
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
    return _checked(strategy)(config=config, **options, **checked)


def brought(strategy: str) -> type[Strategy]:
    """Return the class that a setting ``module:Class`` names, which has to need no arguments.

    Modules are found where Python finds them, and in the working directory.

    Raises:
        ValueError: there is no such Flower strategy, or it cannot work with our clients.
    """
    module, _, name = strategy.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        found = getattr(importlib.import_module(module), name, None)
    except Exception as error:  # whatever the module does while it is imported
        raise ValueError(
            f"strategy={strategy!r} cannot be imported ({type(error).__name__}: {error}): the module has to be in the "
            "working directory, in the app's bundle (fab-include) or installed where the server runs"
        ) from error
    if not (isinstance(found, type) and issubclass(found, Strategy)):
        raise ValueError(f"strategy={strategy!r}: {module} has no class {name!r} derived from Flower's Strategy")
    if issubclass(found, flower.FedXgbBagging | flower.FedXgbCyclic):
        raise ValueError(f"strategy={strategy!r} combines decision trees: give one that combines arrays")
    try:
        found()
    except TypeError as error:
        raise ValueError(f"strategy={strategy!r} needs arguments: derive a class that gives them ({error})") from error
    return found


def _checked(strategy: type[Strategy]) -> type[Checked]:
    """Return the strategy with our checks before it."""
    if issubclass(strategy, Checked):
        return strategy
    counts = issubclass(strategy, flower.DifferentialPrivacyClientSideAdaptiveClipping)
    extra: dict[str, Any] = {"extra_metrics": (KEY_NORM_BIT,)} if counts else {}
    if issubclass(strategy, ADD_NOISE):
        extra["caps_updates"] = False
    return type(f"Checked{strategy.__name__}", (Checked, strategy), extra)
