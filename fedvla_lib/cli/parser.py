"""The commands of `fedvla` and their flags; every setting of a run is a flag."""

import argparse
import inspect
import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

from fedvla_lib.cli.commands import (
    compare,
    config,
    deploy,
    doctor,
    evaluate,
    experiment,
    experts,
    make_credentials,
    pretrain,
    record,
    run,
    search,
    standing_superlink,
    train,
    videos,
)
from fedvla_lib.config import PROFILES, Config
from fedvla_lib.pretraining.recipe import Recipe


class _Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = _Parser(prog="fedvla", description="Federated training of a vision-language-action model.")
    parser.add_argument("--traceback", action="store_true", help="show where an error came from")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _command(commands, "doctor", doctor, "check what this machine lacks to run the book")
    _add_record(commands)
    _add_pretrain(commands)
    _add_experts(commands)
    _add_settings(_command(commands, "config", config, "print the settings as TOML for flwr run --run-config"))
    _add_train(commands)
    _add_run(commands)
    _add_deploy(commands)
    _add_superlink(commands)
    _add_credentials(commands)
    _add_evaluate(commands)
    _add_experiment(commands)
    _add_search(commands)
    _add_compare(commands)
    _add_videos(commands)
    return parser


Handler = Callable[[argparse.Namespace], int | None]


def _command(commands: Any, name: str, handler: Handler, text: str, kept: str = "nothing was written") -> _Parser:
    parser = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    parser.set_defaults(handler=handler, kept=kept)
    return parser


def _add_record(commands: Any) -> None:
    kept = "complete episodes are kept, the same command continues"
    parser = _command(commands, "record", record, "record expert demonstrations as a LeRobot data set", kept)
    _add_profile(parser)
    parser.add_argument("--task", action="append", metavar="NAME", help="a task; repeat for several (default: the mix)")
    parser.add_argument("--episodes", type=int, metavar="N", help="demonstrations of each task")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder to write (default: the chapters' cache)")
    parser.add_argument("--image-size", type=int, metavar="PIXELS", help="side of the camera images")
    parser.add_argument("--num-labs", type=int, metavar="N", help="laboratories to record in, in turn (default: 1)")
    parser.add_argument("--seed", type=int, help="fixes every episode")


def _add_pretrain(commands: Any) -> None:
    kept = "episodes and checkpoints are in the cache, the same command continues"
    parser = _command(commands, "pretrain", pretrain, "make the nano base that comes with this package again", kept)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write")
    for field in fields(Recipe):
        flag, text = "--" + field.name.replace("_", "-"), setting_texts(Recipe)[field.name]
        parser.add_argument(flag, default=field.default, type=field.type, metavar=field.type.__name__.upper(),
                            help=f"{text} (default: {field.default})")  # fmt: skip


def _add_experts(commands: Any) -> None:
    parser = _command(commands, "experts", experts, "measure how often the scripted experts succeed")
    parser.add_argument("--task", action="append", metavar="NAME", help="a task; repeat for several (default: all)")
    parser.add_argument("--episodes", type=int, default=200, metavar="N", help="fresh seeds for a task (default: 200)")


def _add_train(commands: Any) -> None:
    kept = "checkpoints are in the run folder; fedvla train --resume FOLDER continues"
    parser = _command(commands, "train", train, "train on all data in one place, or as one client alone", kept)
    parser.add_argument("--client", type=int, metavar="K", help="train on the part of client K only")
    parser.add_argument("--steps", type=int, metavar="N", help="optimiser steps (default: all rounds' local steps)")
    parser.add_argument("--resume", type=Path, metavar="FOLDER", help="continue this run folder with its own settings")
    _add_settings(parser)


def _add_run(commands: Any) -> None:
    parser = _command(commands, "run", run, "run a federation", "the rounds that ended stay in the run folder")
    text = "inline: in this process, in a fixed order; simulation: Flower's runtime, several processes"
    parser.add_argument("--engine", choices=("inline", "simulation"), default="inline", help=text)
    _add_resume(parser)
    _add_settings(parser)


def _add_resume(parser: argparse.ArgumentParser) -> None:
    text = "go on with this interrupted run, with its own settings"
    parser.add_argument("--resume", type=Path, metavar="RUN_FOLDER", help=text)


def _add_deploy(commands: Any) -> None:
    kept = "every process is stopped; the rounds that ended stay in the run folder"
    text = "run a federation on a SuperLink and SuperNodes of this machine, each a process of its own"
    parser = _command(commands, "deploy", deploy, text, kept)
    text = "the same as --num-clients"
    parser.add_argument("--clients", type=int, dest="num_clients", default=argparse.SUPPRESS, metavar="N", help=text)
    parser.add_argument("--tls", action="store_true", help="encrypt, with certificates made for the occasion")
    parser.add_argument("--auth", action="store_true", help="let in only nodes whose key is known; needs --tls")
    text = "a client's own data set, in the order of clients; repeat for each (default: parts of --data)"
    parser.add_argument("--node-data", action="append", type=Path, metavar="DIR", help=text)
    _add_resume(parser)
    _add_settings(parser)


def _add_superlink(commands: Any) -> None:
    text = "start, stop or look at the SuperLink that flwr run . local-simulation talks to"
    parser = _command(commands, "superlink", standing_superlink, text, "nothing was started")
    text = "status exits with 3 if it is down; last says how the newest run ended, and exits with 2 if it failed"
    parser.add_argument("action", choices=("up", "down", "status", "last"), help=text)


def _add_credentials(commands: Any) -> None:
    text = "make certificates and node keys for a deployment on several hosts"
    parser = _command(commands, "credentials", make_credentials, text)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for the files")
    text = "name or address under which nodes reach the server; repeat for several"
    parser.add_argument("--host", action="append", required=True, metavar="HOST", help=text)
    parser.add_argument("--nodes", type=int, required=True, metavar="N", help="nodes that get a key")


def _add_experiment(commands: Any) -> None:
    kept = "finished cells are kept, the same command continues"
    parser = _command(commands, "experiment", experiment, "train and measure a grid of methods and seeds", kept)
    parser.add_argument(
        "file", type=Path, help="what to measure: a TOML file, see fedvla_lib/experiments/experiment.py"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for one result file a cell")


def _add_search(commands: Any) -> None:
    kept = "finished trials are kept, the same command continues"
    parser = _command(commands, "search", search, "search for settings of a federation at equal gradient steps", kept)
    parser.add_argument("--trials", type=int, default=20, metavar="N", help="settings to try (default: 20)")
    parser.add_argument("--rollouts", type=int, default=20, metavar="N", help="rollouts at each task (default: 20)")
    parser.add_argument("--search-out", type=Path, required=True, metavar="DIR", help="folder of trials and result")
    _add_settings(parser)


def _add_compare(commands: Any) -> None:
    parser = _command(commands, "compare", compare, "compare runs on the same held-out episodes and rollouts")
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="run folders; the first is the reference")
    default = "loss,action_accuracy,success_rate"
    text = f"measurements, separated by commas (default: {default})"
    parser.add_argument("--metrics", default=default, metavar="NAMES", help=text)
    parser.add_argument("--confidence", type=float, default=0.95, help="of the intervals (default: 0.95)")
    parser.add_argument("--seed", type=int, default=42, help="fixes the bootstrap (default: 42)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for JSON, CSV and a figure (default: none)")
    text = "compare runs that measured or spent different things, over what they have in common, and say so"
    parser.add_argument("--allow-mismatch", action="store_true", help=text)


def _add_videos(commands: Any) -> None:
    parser = _command(commands, "videos", videos, "check a run's videos and say what they show, round by round")
    parser.add_argument("folder", type=Path, help="the evaluate folder of a run")
    default = "success_rate,completion_time,action_smoothness"
    text = f"measurements, separated by commas (default: {default})"
    parser.add_argument("--metrics", default=default, metavar="NAMES", help=text)
    parser.add_argument("--who", metavar="NAME", help="only global, or client_K (default: everybody)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for CSV and a figure (default: none)")


def _add_evaluate(commands: Any) -> None:
    kept = "the videos written so far stay"
    parser = _command(commands, "evaluate", evaluate, "let a saved policy act and count its successes", kept)
    parser.add_argument("policy", type=Path, help="a pretrained_model folder, such as <run>/global_model/round_4")
    parser.add_argument("--task", action="append", metavar="NAME", help="a task; repeat for several (default: all)")
    parser.add_argument("--rollouts", type=int, default=20, metavar="N", help="rollouts at each task (default: 20)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for videos and rows.csv (default: none)")
    parser.add_argument("--seed", type=int, default=0, help="fixes the noise of the policy (default: 0)")


def _add_profile(parser: argparse.ArgumentParser) -> None:
    text = f"one of {', '.join(PROFILES)} (default: $FEDVLA_PROFILE, else laptop)"
    parser.add_argument("--profile", metavar="NAME", help=text)


def _add_settings(parser: argparse.ArgumentParser) -> None:
    """Add ``--profile`` and a flag for every setting; only the given ones override the profile."""
    _add_profile(parser)
    group = parser.add_argument_group("settings", "every setting of a run; the default is the profile's")
    meaning = setting_texts()
    for field in fields(Config):
        if field.name == "resume":  # only where there is something to go on with
            continue
        flag, text = "--" + field.name.replace("_", "-"), meaning[field.name].replace("%", "%%")
        typed = {"type": field.type, "metavar": field.type.__name__.upper()}
        kind = {"action": argparse.BooleanOptionalAction} if field.type is bool else typed
        group.add_argument(flag, default=argparse.SUPPRESS, help=text, **kind)


def setting_texts(settings_class: type = Config) -> dict[str, str]:
    """Return the sentence that stands behind each field of a class of settings in its source."""
    return dict(re.findall(r"^    (\w+): \w+ = .*?  # (.+)$", inspect.getsource(settings_class), flags=re.MULTILINE))
