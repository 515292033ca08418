"""The commands of `fedvla` and their flags; every setting of a run is a flag."""

import argparse
import inspect
import re
from dataclasses import Field, fields
from pathlib import Path
from typing import Any, NoReturn

from fedvla_lib.cli import commands, inspection
from fedvla_lib.config import PROFILES, Config
from fedvla_lib.pretraining.recipe import Recipe

TYPES = {"N": int, "K": int, "PIXELS": int, "DIR": Path, "RUN": Path, "RUN_FOLDER": Path, "FILE": Path}  # by metavar
CONTINUES = "the same command continues"
NOTHING, ROUNDS = "nothing was written", "completed rounds are in the run folder"  # what is kept after Ctrl-C
Flag = tuple[str, dict[str, Any]]  # arguments of `add_argument`


class _Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = _Parser(prog="fedvla", description="Federated training of a vision-language-action model.")
    parser.add_argument("--traceback", action="store_true", help="print the traceback of an error")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for handler, text, kept, flags in COMMANDS:
        command = subparsers.add_parser(handler.__name__, help=text, description=text[0].upper() + text[1:] + ".")
        command.set_defaults(handler=handler, kept=kept)
        for name, options in flags:
            command.add_argument(name, **options)
        if handler in WITH_SETTINGS:
            group = command.add_argument_group("settings", "every setting of a run; the profile has the defaults")
            for name, options in _settings():
                group.add_argument(name, **options)
    return parser


def _flag(name: str, text: str, metavar: str | None = None, **options: Any) -> Flag:
    return name, {"help": text} | ({"metavar": metavar, "type": TYPES.get(metavar)} if metavar else {}) | options


def _task(default: str) -> Flag:
    return _flag("--task", f"name of a task; repeat for several (default: {default})", "NAME", action="append")


def _metrics(default: str) -> Flag:
    return _flag("--metrics", f"metrics, separated by commas (default: {default})", "NAMES", default=default)


def _jobs(what: str) -> Flag:
    return _flag("--jobs", f"{what} at a time (default: $FEDVLA_JOBS, else one per core; one for little work)", "N")


def _recipe() -> list[Flag]:
    texts = setting_texts(Recipe)
    return [_field(f, f"{texts[f.name]} (default: {f.default})", f.default) for f in fields(Recipe)]


def _settings() -> list[Flag]:
    """A flag for every setting; only given flags override the profile. ``--resume`` is only where runs resume."""
    texts = {name: text.replace("%", "%%") for name, text in setting_texts().items()}
    return [_field(f, texts[f.name], argparse.SUPPRESS) for f in fields(Config) if f.name != "resume"]


def _field(field: Field, text: str, default: Any) -> Flag:
    typed = {"type": field.type, "metavar": field.type.__name__.upper()}
    kind = {"action": argparse.BooleanOptionalAction} if field.type is bool else typed
    return "--" + field.name.replace("_", "-"), {"help": text, "default": default, **kind}


def setting_texts(settings_class: type = Config) -> dict[str, str]:
    """Return the comment after each field in the source of a settings class."""
    return dict(re.findall(r"^    (\w+): \w+ = .*?  # (.+)$", inspect.getsource(settings_class), flags=re.MULTILINE))


GIVEN = {"default": argparse.SUPPRESS}  # only given flags override the profile
NEEDED = {"required": True}
PROFILE = _flag("--profile", f"one of {', '.join(PROFILES)} (default: $FEDVLA_PROFILE, else laptop)", "NAME")
RESUME = _flag("--resume", "run folder of an interrupted run to resume with its own settings", "RUN_FOLDER")
WITH_SETTINGS = (commands.config, commands.train, commands.run, commands.deploy)
COMMANDS = (  # handler, help, what Ctrl-C keeps, flags
    (commands.doctor, "check that this machine can run the book", NOTHING, []),
    (commands.record, "record expert demonstrations as a LeRobot data set",
     f"complete episodes are kept, {CONTINUES}", [
        PROFILE, _task("those of the profile"),
        _flag("--episodes", "demonstrations per task", "N", dest="episodes_per_task", **GIVEN),
        _flag("--out", "the folder to write to (default: the cache, where the chapters find it)", "DIR", dest="folder"),
        _flag("--image-size", "side length of the square camera images", "PIXELS", **GIVEN),
        _flag("--num-labs", "labs to record in, in turn (default: 1)", "N", **GIVEN),
        _flag("--seed", "seed of all episodes", type=int, **GIVEN),
    ]),
    (inspection.inspect, "check a data set and say how to mend it; exit status 0: no finding is an error, 1: one is, "
     "2: the data set cannot be found or has no readable description", NOTHING, [
        _flag("source", "a folder in LeRobot's format, or a hub id", metavar="DATA"),
        _flag("--reference", "a data set whose calibration and cameras are right, to compare with", "DATA"),
        _flag("--json", "the file to write findings to as well, for scripts", "FILE"),
        *(setting for setting in _settings() if setting[0] in ("--camera-map", "--fps", "--chunk-size")), PROFILE,
    ]),
    (commands.pretrain, "pretrain the nano base that comes with this package",
     f"episodes and checkpoints are in the cache, {CONTINUES}",
     [_flag("--out", "the folder to write to", "DIR", **NEEDED), *_recipe()]),
    (commands.experts, "measure the success rates of the scripted experts", NOTHING, [
        _task("all"), _flag("--episodes", "episodes per task (default: 200)", "N", default=200),
    ]),
    (commands.config, "print the settings as TOML for flwr run --run-config", NOTHING, [PROFILE]),
    (commands.train, "train a policy without federation: on all data, or on one client's partition",
     "checkpoints are in the run folder; fedvla train --resume FOLDER continues", [
        _flag("--client", "train on client K's partition only", "K"),
        _flag("--steps", "gradient steps (default: num-server-rounds times local-steps)", "N"), RESUME, PROFILE,
    ]),
    (commands.run, "run federated training with simulated clients", ROUNDS, [
        _flag("--engine", "inline: one client after the other, in this process; simulation: Flower's simulation, in "
              "several processes", choices=("inline", "simulation"), default="inline"),
        _jobs("clients of the inline engine"), RESUME, PROFILE,
    ]),
    (commands.deploy, "run a federation on a SuperLink and SuperNodes, each a process on this machine",
     f"every process is stopped; {ROUNDS}", [
        _flag("--clients", "the same as --num-clients", "N", dest="num_clients", **GIVEN),
        _flag("--tls", "encrypt connections, with certificates made for this run", action="store_true"),
        _flag("--auth", "accept only nodes with a registered key; needs --tls", action="store_true"),
        _flag("--node-data", "the folder of one client's own data set; repeat for every client, in order (default: "
              "parts of --data)", "DIR", action="append"), RESUME, PROFILE,
    ]),
    (commands.superlink, "start, stop or check the SuperLink service for flwr run . local-simulation",
     "nothing was started", [
        _flag("action", "status exits with 3 if it is not up; last reports the newest run, and exits with 2 if that "
              "failed", choices=("up", "down", "status", "last")),
    ]),
    (commands.credentials, "make certificates and node keys for a deployment on several hosts", NOTHING, [
        _flag("--out", "the new folder for the files", "DIR", **NEEDED),
        _flag("--host", "host name or address at which nodes reach the server; repeat for several", "HOST",
              action="append", **NEEDED),
        _flag("--nodes", "number of nodes; each gets a key", "N", **NEEDED),
    ]),
    (commands.evaluate, "measure the success rates of a saved policy in rollouts", "videos written so far are kept", [
        _flag("policy", "a pretrained_model folder, such as <run>/global_model/round_4", type=Path), _task("all"),
        _flag("--rollouts", "rollouts per task (default: 20)", "N", default=20),
        _flag("--out", "the folder for videos and rows.csv (default: none)", "DIR"),
        _flag("--seed", "seed of the policy's noise (default: 0)", type=int, default=0), _jobs("groups of rollouts"),
    ]),
    (commands.export, "copy a saved policy so that LeRobot's commands load it from any working directory", NOTHING, [
        _flag("policy", "a pretrained_model folder, such as <run>/global_model/round_4", type=Path),
        _flag("--for", "where the copy will be when it is loaded; its files name this place", "PLACE", dest="place",
              **NEEDED),
        _flag("--out", "the folder to write, if PLACE is on another machine (default: PLACE)", "DIR"),
    ]),
    (commands.experiment, "train and measure a grid of methods, partitions and seeds",
     f"finished cells are kept, {CONTINUES}", [
        _flag("file", "the plan, a TOML file; see fedvla_lib/experiments/experiment_file.py", type=Path),
        _flag("--out", "the folder for the results, a run folder per cell", "DIR", **NEEDED),
        _jobs("cells"),
    ]),
    (commands.compare, "compare runs, paired by held-out episode and by rollout", NOTHING, [
        _flag("runs", "run folders; the first is the reference", "RUN", nargs="+"),
        _metrics("loss,action_accuracy,success_rate"),
        _flag("--confidence", "confidence level of the intervals (default: 0.95)", type=float, default=0.95),
        _flag("--seed", "seed of the bootstrap (default: 42)", type=int, default=42),
        _flag("--out", "the folder for JSON, CSV and a figure (default: none)", "DIR"),
        _flag("--allow-mismatch", "compare runs even if data, gradient steps or rollouts differ; the differences are "
              "listed", action="store_true"),
    ]),
    (commands.videos, "check a run's rollout videos and report metrics by round", NOTHING, [
        _flag("folder", "the evaluate folder of a run", type=Path),
        _metrics("success_rate,completion_time,action_smoothness"),
        _flag("--who", "only rollouts of global, or of client_K (default: all)", "NAME"),
        _flag("--out", "the folder for CSV and a figure (default: none)", "DIR"),
    ]),
)  # fmt: skip
