"""What a full-size run would cost with a card in each lab: an estimate from counted operations and assumptions.

Nothing here is measured but the number of operations and of weights; `Assumptions` holds the rest.
"""

from dataclasses import dataclass

from fedvla_lib.config import PROFILES, Config

BYTES = 4  # of a number in float32
KEPT = 3  # numbers beside each trained weight: its gradient and AdamW's two moments


@dataclass(frozen=True)
class Assumptions:
    """Prices, speeds and the plan of a run. Prices are round figures, to be replaced by those of an offer."""

    usd_per_hour: float = 2.0  # of a rented card, and of its machine
    peak_tflops: float = 312.0  # bfloat16 products of the card: an NVIDIA A100's data sheet
    utilisation: float = 0.3  # share of the peak that training reaches
    line_mbit: float = 100.0  # megabits per second of a lab's line, in each direction
    usd_per_gb: float = 0.1  # of data that leave the server
    rounds: int = Config.num_server_rounds
    local_steps: int = PROFILES["gpu"]["local_steps"]
    batch_size: int = PROFILES["gpu"]["batch_size"]


@dataclass(frozen=True)
class Cost:
    """Cost of a run: hours are of the wall, for labs that train side by side."""

    hours: float
    memory_gb: float  # on a card: weights, gradients and optimiser, without activations
    exchanged_gb: float  # to and from all labs, in all rounds
    usd: float


def cost(labs: int, parameters: int, trained: int, step_gflops: float, given: Assumptions) -> Cost:
    """Estimate a run of `labs` labs, each with a card of its own; one lab trains alone and sends nothing.

    Args:
        parameters: of the model; trained: of those, the ones that train and are exchanged.
        step_gflops: 1e9 operations of a training step on one sample, forward and backward.

    Raises:
        ValueError: no lab, or a speed or a price that is not above zero.
    """
    if labs < 1 or min(given.peak_tflops, given.utilisation, given.line_mbit, given.usd_per_hour) <= 0:
        raise ValueError(f"{labs} labs, {given}: give one lab or more, and speeds and prices above 0")
    steps = given.rounds * given.local_steps
    computing_s = steps * given.batch_size * step_gflops / (1000 * given.peak_tflops * given.utilisation)
    update_gb = BYTES * trained / 1e9 if labs > 1 else 0.0
    waiting_s = given.rounds * 2 * 8000 * update_gb / given.line_mbit
    hours, sent_gb = (computing_s + waiting_s) / 3600, given.rounds * labs * update_gb
    memory_gb = BYTES * (parameters + KEPT * trained) / 1e9
    usd = labs * hours * given.usd_per_hour + sent_gb * given.usd_per_gb
    return Cost(hours, memory_gb, 2 * sent_gb, usd)
