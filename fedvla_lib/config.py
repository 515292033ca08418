"""Every setting of a run in one frozen dataclass, its three profiles, and the only parser of run settings.

The same names, written with dashes, are the keys of ``[tool.flwr.app.config]`` in pyproject.toml and of
``flwr run --run-config``. A profile is a set of numbers, never a branch in the code.
"""

import os
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Config:
    """Settings of a run; a default is the laptop profile's value."""

    # data
    data: str = ""  # LeRobot data set: a local folder or a hub id; empty records in simulation and caches
    tasks: str = "lift,place,push"  # task mix, comma separated; a client's rollouts use the tasks it holds
    episodes_per_task: int = 40  # demonstrations recorded per task when `data` is empty
    image_size: int = 96  # side of the square camera images in pixels
    num_labs: int = 1  # laboratories the demonstrations come from: cameras, light, colours and calibration differ
    val_fraction: float = 0.1  # share of episodes held out for validation, per task
    normalisation: str = "pooled"  # statistics of joints: pooled; or a mistake to measure: own, held-out, none
    augment: bool = False  # jitter training images; off, a frozen model's view of a frame is computed once and kept
    # federation
    num_clients: int = 10  # clients the episodes are partitioned over
    partition: str = "modulo"  # modulo, task, dirichlet or lab
    dirichlet_alpha: float = 0.5  # concentration of the Dirichlet partition; small means one task per client
    num_server_rounds: int = 10  # rounds of federated averaging
    fraction_train: float = 0.4  # share of clients that train in a round
    fraction_evaluate: float = 1.0  # share of clients that evaluate in a round
    min_replies: int = 1  # good training replies a round needs, else the run stops
    round_timeout_s: float = 14400.0  # seconds a round waits for its clients; who has not answered by then is left out
    strategy: str = "fedavg"  # fedavg, fedprox, fedavgm, fedadam, fedyogi, fedmedian, krum or scaffold
    server_lr: float = 0.0  # step size of the server in fedavgm, fedadam and fedyogi; 0 takes the strategy's default
    server_momentum: float = 0.5  # fedavgm: share of the last server step that goes on; at 0.9 steps grow tenfold
    clip_norm: float = 0.0  # longest movement of a client in a round that counts whole; 0 counts all whole
    num_malicious: int = 1  # krum: clients drawn for a round that may send anything
    personal: str = ""  # parts of the model that stay with each client, comma separated: projections, expert layer N
    exchange: str = "float32"  # bits that travel: float32, float16, or int8 (float16 on the way down)
    proximal_mu: float = 0.1  # fedprox: weight of the pull towards the global model
    # model
    base: str = "nano"  # 'nano' (pretrained, in this package), 'nano-random', a local folder or a hub id
    chunk_size: int = 16  # future actions predicted at once; 50 in smolvla_base
    n_action_steps: int = 8  # actions of a chunk carried out before the model looks again
    freeze_vision_encoder: bool = True  # keep the vision encoder fixed
    train_expert_only: bool = True  # keep the whole vision-language model fixed, train expert and projections
    lora_rank: int = 0  # rank of adapters that train instead of the expert's weights; 0 trains the weights themselves
    lora_freeze_a: bool = False  # train only one of the two adapter matrices, which makes their average exact
    train_state_proj: bool = False  # also train the projection of the arm's state into the prefix
    # local training
    local_steps: int = 20  # optimiser steps of a client in a round
    batch_size: int = 32  # samples per optimiser step
    lr: float = 1e-3  # peak learning rate of AdamW; smolvla_base uses 1e-4
    keep_optimizer: bool = False  # a client's optimiser goes on in its next round instead of starting afresh
    warmup_steps: int = 20  # linear warm-up of the learning rate, in steps
    checkpoint_every: int = 200  # steps between checkpoints of local training; 0 keeps only the last
    # evaluation
    validate_every: int = 1  # rounds between global models that are kept and measured on held-out episodes
    eval_every: int = 5  # rounds between closed-loop evaluations; 0 evaluates after the last round only
    eval_rollouts: int = 4  # rollouts per task of the global model at each evaluation
    client_rollouts: int = 1  # rollouts (with video) of the global model on each client at each evaluation
    action_tolerance_deg: float = 5.0  # a predicted joint target within this of the demonstration counts as accurate
    # run
    seed: int = 0  # fixes data order, initial weights, noise, client sampling and rollouts
    device: str = "cpu"  # torch device: cpu, cuda or mps; cpu gives way where Flower reserves a card for a client
    num_threads: int = 0  # torch threads; 0 takes the cores granted to this process
    out: str = "outputs"  # where run folders are made
    resume: str = ""  # run folder of an interrupted run to go on with; empty starts a new one


PROFILES: dict[str, dict[str, Any]] = {
    "tiny": {
        "episodes_per_task": 4,
        "image_size": 64,
        "num_clients": 3,
        "num_server_rounds": 2,
        "fraction_train": 1.0,
        "local_steps": 2,
        "batch_size": 4,
        "warmup_steps": 1,
        "eval_every": 0,
        "eval_rollouts": 1,
        "checkpoint_every": 2,
        "num_threads": 1,  # for work this small a second thread costs more than it brings
    },
    "laptop": {},
    "gpu": {
        "base": "lerobot/smolvla_base",
        "train_state_proj": True,
        "augment": True,
        "image_size": 224,
        "chunk_size": 50,
        "n_action_steps": 50,
        "episodes_per_task": 100,
        "fraction_train": 1.0,
        "local_steps": 200,
        "batch_size": 64,
        "lr": 1e-4,
        "warmup_steps": 200,
        "eval_every": 5,
        "eval_rollouts": 20,
        "device": "cuda",
    },
}
PARTITIONS = ("modulo", "task", "dirichlet", "lab")
NORMALISATIONS = ("pooled", "own", "held-out", "none")
EXCHANGES = ("float32", "float16", "int8")
STRATEGIES = ("fedavg", "fedprox", "fedavgm", "fedadam", "fedyogi", "fedmedian", "krum", "scaffold")


def from_profile(name: str | None = None, **overrides: Any) -> Config:
    """Return the settings of profile `name` (default: ``$FEDVLA_PROFILE``, else laptop) with `overrides` on top.

    Raises:
        ValueError: unknown profile or setting, or a value out of range; the message lists the valid ones.
    """
    name = name or os.environ.get("FEDVLA_PROFILE", "laptop")
    if name not in PROFILES:
        raise ValueError(f"unknown profile {name!r}: choose one of {', '.join(PROFILES)}")
    return check(replace(Config(), **{**PROFILES[name], **_known(overrides)}))


def from_run_config(run_config: dict[str, Any]) -> Config:
    """Parse Flower's run config, whose keys are the field names with dashes (``num-server-rounds``)."""
    values = _known({key.replace("-", "_"): value for key, value in run_config.items()})
    types = {field.name: field.type for field in fields(Config)}
    return check(Config(**{key: _cast(key, value, types[key]) for key, value in values.items()}))


def to_run_config(config: Config) -> dict[str, Any]:
    """Return the settings as Flower run config, the inverse of `from_run_config`."""
    return {key.replace("_", "-"): value for key, value in asdict(config).items()}


def task_names(config: Config) -> list[str]:
    """Return the tasks of the mix as a list."""
    return [name.strip() for name in config.tasks.split(",") if name.strip()]


def personal_parts(config: Config) -> list[str]:
    """Return the parts of the model that stay with each client as a list."""
    return [name.strip() for name in config.personal.split(",") if name.strip()]


def granted_threads(config: Config) -> int:
    """Return the torch threads to use: `num_threads`, or the cores this process may run on."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return config.num_threads or cores


def check(config: Config) -> Config:
    """Return `config` if every value is usable, else raise ValueError naming the setting, the value and the range."""
    positive = (
        "episodes_per_task", "image_size", "num_labs", "num_clients", "num_server_rounds", "min_replies", "chunk_size",
        "n_action_steps", "local_steps", "batch_size", "lr", "dirichlet_alpha", "action_tolerance_deg",
        "validate_every", "round_timeout_s",
    )  # fmt: skip
    for name in positive:
        _require(getattr(config, name) > 0, config, name, "a number above 0")
    countable = (
        "warmup_steps", "checkpoint_every", "eval_every", "eval_rollouts", "client_rollouts", "num_threads", "seed",
        "server_lr", "proximal_mu", "lora_rank", "clip_norm", "num_malicious",
    )  # fmt: skip
    for name in countable:
        _require(getattr(config, name) >= 0, config, name, "0 or more")
    for name in ("fraction_train", "fraction_evaluate", "val_fraction", "server_momentum"):
        _require(0 <= getattr(config, name) <= 1, config, name, "a share from 0 to 1")
    _require(config.fraction_train > 0, config, "fraction_train", "a share above 0")
    _require(config.partition in PARTITIONS, config, "partition", f"one of {', '.join(PARTITIONS)}")
    _require(config.normalisation in NORMALISATIONS, config, "normalisation", f"one of {', '.join(NORMALISATIONS)}")
    _require(config.strategy in STRATEGIES, config, "strategy", f"one of {', '.join(STRATEGIES)}")
    _require(config.exchange in EXCHANGES, config, "exchange", f"one of {', '.join(EXCHANGES)}")
    most = f"at most chunk_size={config.chunk_size}"
    _require(config.n_action_steps <= config.chunk_size, config, "n_action_steps", most)
    _require(bool(task_names(config)), config, "tasks", "a comma separated list of tasks")
    return config


def _require(ok: bool, config: Config, name: str, valid: str) -> None:
    if not ok:
        raise ValueError(f"{name.replace('_', '-')}={getattr(config, name)!r} is not usable: give {valid}")


def _known(values: dict[str, Any]) -> dict[str, Any]:
    names = [field.name for field in fields(Config)]
    for key in values:
        if key not in names:
            raise ValueError(f"unknown setting {key!r}: choose one of {', '.join(names)}")
    return values


def _cast(key: str, value: Any, kind: type) -> Any:
    """Flower parses ``lr=1`` as an int; accept that, but no string where a number belongs."""
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not kind:
        raise ValueError(f"{key.replace('_', '-')}={value!r} has type {type(value).__name__}: give {kind.__name__}")
    return value


def absolute(config: Config) -> Config:
    """Return settings with absolute paths: Flower's processes choose their own working directory. Hub ids stay."""
    paths = {name: getattr(config, name) for name in ("data", "base", "resume")}
    found = {name: str(Path(path).resolve()) for name, path in paths.items() if path and Path(path).exists()}
    return replace(config, out=str(Path(config.out).resolve()), **found)
