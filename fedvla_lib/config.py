"""All settings of a run in one frozen dataclass, its three profiles, and the only parser of run settings.

The same names, written with dashes, are the keys of ``[tool.flwr.app.config]`` in pyproject.toml and of
``flwr run --run-config``. A profile is a set of values; the code never branches on its name.
"""

import os
import re
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Config:
    """Settings of a run; the defaults are the laptop profile. Each comment is the help text of a flag."""

    # data
    data: str = ""  # LeRobot data set: a local folder or a hub id; empty records demonstrations and caches them
    client_data: str = ""  # a data set for each client, comma separated; then the server measures on `data`, if given
    camera_map: str = ""  # which camera of `data` is which of the policy: top=overhead,wrist=front; empty: by name
    fps: int = 10  # actions of the policy per second; recordings with more frames per second are resampled
    tasks: str = "lift,place,push"  # task names, comma separated; a client is evaluated on the tasks in its own data
    episodes_per_task: int = 40  # demonstrations recorded per task when `data` is empty
    image_size: int = 96  # side length of the square camera images, in pixels
    num_labs: int = 1  # labs that record demonstrations; each has its cameras, light, colours, calibration, operator
    one_task_per_lab: bool = False  # lab k records only task k, counted modulo the number of tasks
    val_fraction: float = 0.1  # fraction of each task's episodes held out for validation
    normalisation: str = "pooled"  # joint statistics: pooled, base (saved with it), or a mistake: own, held-out, none
    augment: bool = False  # augment training images; if off, the prefix of a frozen model is cached for each frame
    # federation
    num_clients: int = 10  # clients that the episodes are partitioned over
    partition: str = "modulo"  # how episodes are partitioned: modulo, task, dirichlet or lab
    dirichlet_alpha: float = 0.5  # concentration of the Dirichlet partition; small values give a client few tasks
    num_server_rounds: int = 10  # federated rounds
    fraction_train: float = 0.4  # fraction of clients that train in each round
    sampling: str = "uniform"  # who trains in a round: uniform, or by-task (the tasks that clients announce take turns)
    fraction_evaluate: float = 1.0  # fraction of clients that evaluate in each round
    min_replies: int = 1  # valid training replies needed in each round; with fewer the run stops
    frames_cap: float = 10.0  # a client counts for at most this many times the median number of frames; 0: no limit
    update_cap: float = 3.0  # an update longer than this many times the median of its round is shortened; 0: no limit
    reply_limit_mb: float = 0.0  # largest reply of a client, in MB; 0: 100, and twice the arrays
    node_keys: str = ""  # the server's folder of public keys node_K.pub: client K signs its number with that key
    round_timeout_s: float = 14400.0  # seconds that a round waits for replies; later replies are left out
    strategy: str = "fedavg"  # one of `STRATEGIES`, for example fedavg, or module:Class of a Flower strategy of yours
    server_lr: float = 0.0  # server learning rate of fedavgm, fedadam, fedyogi, diloco; 0 uses the strategy's default
    server_momentum: float = 0.5  # fedavgm, diloco: server momentum m; constant updates are scaled by 1 / (1 - m)
    clip_norm: float = 0.0  # maximum L2 norm of a client's update; 0 does not clip
    clip_quantile: float = 0.0  # adapt clip_norm so that this share of the clients is not clipped; 0 keeps it
    noise: float = 0.0  # standard deviation of the noise on the sum of updates, in units of clip_norm; 0 adds none
    noise_by: str = "server"  # who adds the noise: server, client (each all of it) or together (each a part)
    secret_noise: bool = False  # take the noise from the system's entropy and not from the seed, which others may know
    epsilon_budget: float = 0.0  # highest epsilon of a run, see federation/accountant.py; 0 sets no limit
    delta: float = 0.0  # probability that goes with epsilon; 0 uses num_clients^-1.1
    secure_aggregation: bool = False  # the server learns only the sum of the updates
    num_malicious: int = 1  # krum: Byzantine clients tolerated per round
    personal: str = ""  # model parts that stay on each client, comma separated: projections, expert layer N
    exchange: str = "float32"  # format of exchanged weights: float32, float16, or int8 (float16 from server to clients)
    proximal_mu: float = 0.1  # fedprox: weight of the proximal term
    # model
    base: str = "nano"  # base model: nano (pretrained, in this package), nano-random, a local folder or a hub id
    chunk_size: int = 16  # actions predicted per chunk; smolvla_base uses 50
    n_action_steps: int = 8  # actions of a chunk that are executed before the next observation
    freeze_vision_encoder: bool = True  # freeze the vision encoder
    train_expert_only: bool = True  # freeze the vision-language model; train the action expert and projections only
    lora_rank: int = 0  # rank of LoRA adapters that train in place of the expert's weights; 0 trains the weights
    lora_freeze_a: bool = False  # train only the B matrices of the adapters, which makes averaging them exact
    train_state_proj: bool = False  # also train the projection of the joint state into the prefix
    # local training
    local_steps: int = 20  # gradient steps of a client in each round
    batch_size: int = 32  # samples per gradient step
    alone_steps: int = 0  # gradient steps of centralized and local-only training; 0 takes them from the federation
    lr: float = 1e-3  # peak learning rate of the local optimiser; smolvla_base uses 1e-4
    local_optimizer: str = "adamw"  # adamw, sgd, adamw-shared or adamw-frozen, see policy/optimizers.py
    keep_optimizer: bool = False  # keep a client's optimiser state from round to round
    warmup_steps: int = 20  # gradient steps of linear learning rate warm-up
    mixed_precision: bool = False  # training computes products in bfloat16; weights, optimiser, exchange stay float32
    gradient_checkpointing: bool = False  # keep less for the backward pass and compute it again: slower, less memory
    checkpoint_every: int = 200  # gradient steps between checkpoints of local training; 0 keeps only the last
    # evaluation
    validate_every: int = 1  # rounds between saved global models, each evaluated on the held-out episodes
    keep_last: int = 0  # saved global models that stay on the disk: the last so many; 0 keeps all
    keep_every: int = 0  # and those of every so many rounds; 0 keeps no more than the last
    eval_every: int = 5  # rounds between closed-loop evaluations; 0 evaluates after the last round only
    eval_rollouts: int = 4  # rollouts per task at each evaluation of the global model
    videos: bool = True  # record the rollouts of the global model on video
    client_rollouts: int = 1  # rollouts (with video) of the global model on each client at each evaluation
    action_tolerance_deg: float = 5.0  # maximum error, in degrees, of a predicted joint target that counts as accurate
    # run
    seed: int = 0  # seed of data order, initial weights, noise, client sampling and rollouts
    device: str = "cpu"  # torch device: cpu, cuda or mps; cpu becomes cuda where Flower reserves a GPU for a client
    num_threads: int = 0  # torch threads; 0 uses one for a small policy, else all cores granted to this process
    out: str = "outputs"  # parent folder of the run folders
    resume: str = ""  # run folder of an interrupted run to resume; empty starts a new run


PROFILES: dict[str, dict[str, Any]] = {
    "tiny": {  # one thread: a second one costs more than it gains on so little work
        "episodes_per_task": 4, "image_size": 64, "num_clients": 3, "num_server_rounds": 2, "fraction_train": 1.0,
        "local_steps": 2, "batch_size": 4, "warmup_steps": 1, "eval_every": 0, "eval_rollouts": 1,
        "checkpoint_every": 2, "num_threads": 1,
    },
    "laptop": {},
    "gpu": {
        "base": "lerobot/smolvla_base", "train_state_proj": True, "augment": True, "image_size": 224, "chunk_size": 50,
        "n_action_steps": 50, "episodes_per_task": 100, "fraction_train": 1.0, "local_steps": 200, "batch_size": 64,
        "lr": 1e-4, "warmup_steps": 200, "eval_every": 5, "eval_rollouts": 20, "device": "cuda",
        "mixed_precision": True,
    },
}  # fmt: skip
PARTITIONS = ("modulo", "task", "dirichlet", "lab")
NORMALISATIONS = ("pooled", "base", "own", "held-out", "none")
NOISE_BY = ("server", "client", "together")
EXCHANGES = ("float32", "float16", "int8")
STRATEGIES = (
    "fedavg", "fedprox", "fedavgm", "fedadam", "fedyogi", "diloco", "fedexp", "fedmedian", "krum", "scaffold",
)  # fmt: skip
BROUGHT = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")  # a strategy that is not of this library
SAMPLINGS = ("uniform", "by-task")
LOCAL_OPTIMIZERS = ("adamw", "sgd", "adamw-shared", "adamw-frozen")


POSITIVE = {
    "episodes_per_task", "image_size", "fps", "num_labs", "num_clients", "num_server_rounds", "min_replies",
    "chunk_size", "n_action_steps", "local_steps", "batch_size", "lr", "dirichlet_alpha", "action_tolerance_deg",
    "validate_every", "round_timeout_s",
}  # fmt: skip
MOST = {  # more is a slip of the keyboard, or takes more memory than there is
    "episodes_per_task": 1e6, "image_size": 4096, "fps": 1000, "num_labs": 1000, "num_clients": 1e5,
    "num_server_rounds": 1e6, "min_replies": 1e5, "frames_cap": 1e9, "update_cap": 1e9, "reply_limit_mb": 1e9,
    "round_timeout_s": 1e9, "server_lr": 1e6, "clip_norm": 1e9, "noise": 1e6,
    "epsilon_budget": 1e6, "num_malicious": 1e5, "proximal_mu": 1e6, "dirichlet_alpha": 1e6, "chunk_size": 10_000,
    "n_action_steps": 10_000, "lora_rank": 4096, "local_steps": 1e7, "batch_size": 65_536, "alone_steps": 1e9,
    "lr": 1e9, "warmup_steps": 1e9, "checkpoint_every": 1e9, "validate_every": 1e9, "keep_last": 1e9, "keep_every": 1e9,
    "eval_every": 1e9, "eval_rollouts": 1e6, "client_rollouts": 1e6, "action_tolerance_deg": 360,
    "seed": 2**63 - 1, "num_threads": 1024,
}  # fmt: skip
DEVICE = re.compile(r"cpu|mps|cuda(:\d{1,3})?")


def from_profile(name: str | None = None, **overrides: Any) -> Config:
    """Return the settings of profile `name` (default: ``$FEDVLA_PROFILE``, else laptop), updated with `overrides`.

    Raises:
        ValueError: unknown profile or setting, or value out of range; the message lists the valid ones.
    """
    name = name or os.environ.get("FEDVLA_PROFILE", "laptop")
    if owned := split_names(overrides.get("client_data", "")):
        overrides = {"num_clients": len(owned)} | overrides
    if name not in PROFILES:
        raise ValueError(f"unknown profile {name!r}: choose one of {', '.join(PROFILES)}")
    return from_run_config(PROFILES[name] | _require_known(overrides))


def from_run_config(run_config: dict[str, Any]) -> Config:
    """Parse Flower's run config, whose keys are the field names with dashes (``num-server-rounds``)."""
    values = _require_known({key.replace("-", "_"): value for key, value in run_config.items()})
    types = {field.name: field.type for field in fields(Config)}
    return check(Config(**{key: _cast(key, value, types[key]) for key, value in values.items()}))


def to_run_config(config: Config) -> dict[str, Any]:
    """Return the settings as Flower run config, the inverse of `from_run_config`."""
    return {key.replace("_", "-"): value for key, value in asdict(config).items()}


def task_names(config: Config) -> list[str]:
    """Return `config.tasks` as a list."""
    return split_names(config.tasks)


def split_names(names: str) -> list[str]:
    """Return names that are separated by commas as a list."""
    return [name.strip() for name in names.split(",") if name.strip()]


def sample_size(share: float, num_clients: int) -> int:
    """Return how many clients a round samples: at least one, or none if the share is 0."""
    return max(1, round(share * num_clients)) if share else 0


def granted_cores() -> int:
    """Return the number of CPU cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check(config: Config) -> Config:
    """Return `config`, or raise ValueError with the setting, its value and the valid range if a value is unusable."""
    for name, most in MOST.items():
        value, least = getattr(config, name), "above 0" if name in POSITIVE else "from 0"
        usable = 0 <= value <= most and (value > 0 or name not in POSITIVE)  # no comparison holds for NaN
        _require(usable, config, name, f"a number {least}, at most {most:g}")
    for name in ("fraction_train", "fraction_evaluate", "val_fraction", "server_momentum", "clip_quantile", "delta"):
        _require(0 <= getattr(config, name) <= 1, config, name, "a number from 0 to 1")
    _require(config.fraction_train > 0, config, "fraction_train", "a number above 0")
    choices = {
        "partition": PARTITIONS, "normalisation": NORMALISATIONS, "exchange": EXCHANGES, "sampling": SAMPLINGS,
        "local_optimizer": LOCAL_OPTIMIZERS, "noise_by": NOISE_BY,
    }  # fmt: skip
    for name, valid in choices.items():
        _require(getattr(config, name) in valid, config, name, f"one of {', '.join(valid)}")
    known = config.strategy in STRATEGIES or BROUGHT.fullmatch(config.strategy)
    _require(bool(known), config, "strategy", f"one of {', '.join(STRATEGIES)}, or module:Class of a Flower strategy")
    limit = f"at most chunk_size={config.chunk_size}"
    _require(config.n_action_steps <= config.chunk_size, config, "n_action_steps", limit)
    whole = not config.one_task_per_lab or config.num_labs % max(1, len(task_names(config))) == 0
    _require(whole, config, "num_labs", "a multiple of the number of tasks if each lab has one task")
    apart = not config.personal or not config.local_optimizer.startswith("adamw-")
    _require(apart, config, "local_optimizer", "adamw or sgd for a model with personal parts")
    owned = len(split_names(config.client_data))
    _require(owned in (0, config.num_clients), config, "num_clients", f"{owned}, one for each data set of client-data")
    here = config.data or not owned or config.normalisation != "held-out"
    _require(here, config, "normalisation", "pooled, base or none: the server has no held-out data")
    once = bool(task_names(config)) and len(set(task_names(config))) == len(task_names(config))
    _require(once, config, "tasks", "task names separated by commas, each once")
    _require(DEVICE.fullmatch(config.device) is not None, config, "device", "cpu, cuda, cuda:K or mps")
    drawn = sample_size(config.fraction_train, config.num_clients)
    few = config.strategy != "krum" or 2 * config.num_malicious < drawn
    _require(few, config, "num_malicious", f"less than half of the {drawn} clients of a round")
    _check_privacy(config)
    return config


def _check_privacy(config: Config) -> None:
    """Raise ValueError for settings under which noise or secure aggregation would not keep what they promise."""
    hidden = config.secure_aggregation or (config.noise > 0 and config.noise_by != "server")
    if not (config.noise or config.secure_aggregation or config.clip_quantile):
        return
    _require(config.clip_norm > 0, config, "clip_norm", "the norm to clip to: noise and secure aggregation need one")
    _require(not config.clip_quantile or not hidden, config, "clip_quantile", "0 if the server sees no update's norm")
    apart = config.noise_by != "together" or config.secure_aggregation
    _require(apart, config, "noise_by", "server or client; together needs secure-aggregation")
    if not (config.noise or config.secure_aggregation):
        return
    sent = config.normalisation in ("base", "none")
    _require(sent, config, "normalisation", "base or none: the clients' statistics would be released without noise")
    mixes = hidden and not config.secure_aggregation or config.strategy not in ("fedexp", "fedmedian", "krum")
    _require(mixes, config, "strategy", "one that needs the mean only: fedexp, fedmedian and krum look at each update")
    _require(config.num_clients > 1, config, "num_clients", "2 or more: one client has nobody to hide among")
    _require(config.delta < 1, config, "delta", "a number below 1")
    secret = config.secret_noise or not config.epsilon_budget
    _require(secret, config, "secret_noise", "True with an epsilon-budget: noise from a known seed protects nobody")
    if not hidden:
        return
    _require(config.fraction_evaluate == 0, config, "fraction_evaluate", "0: clients' results would tell of their data")
    _require(config.sampling == "uniform", config, "sampling", "uniform: clients do not announce their tasks")
    if config.secure_aggregation:
        _require(config.exchange == "float32", config, "exchange", "float32: masked numbers have a format of their own")
        drawn = sample_size(config.fraction_train, config.num_clients)
        _require(drawn >= 3, config, "fraction_train", "a share of 3 clients or more: fewer cannot hide")


def _require(ok: bool, config: Config, name: str, valid: str) -> None:
    if not ok:
        raise ValueError(f"{name.replace('_', '-')}={getattr(config, name)!r} is not usable: give {valid}")


def _require_known(values: dict[str, Any]) -> dict[str, Any]:
    names = [field.name for field in fields(Config)]
    if unknown := [key for key in values if key not in names]:
        raise ValueError(f"unknown setting {unknown[0]!r}: choose one of {', '.join(names)}")
    return values


def _cast(key: str, value: Any, kind: type) -> Any:
    """Return `value` as `kind`: Flower parses ``lr=1`` as an int, which is accepted; a string for a number is not."""
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not kind:
        raise ValueError(f"{key.replace('_', '-')}={value!r} has type {type(value).__name__}: give {kind.__name__}")
    return value


def absolute(config: Config) -> Config:
    """Make local paths absolute, since Flower's processes choose their own working directory. Hub ids stay."""
    paths = {name: getattr(config, name) for name in ("data", "base", "resume", "node_keys")}
    local = {name: str(Path(path).resolve()) for name, path in paths.items() if path and Path(path).exists()}
    owned = [str(Path(path).resolve()) if Path(path).exists() else path for path in split_names(config.client_data)]
    return replace(config, out=str(Path(config.out).resolve()), client_data=",".join(owned), **local)
