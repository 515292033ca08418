"""The commands of `fedvla` and their flags; every setting of a run is a flag."""

import argparse
import inspect
import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

from fedvla_lib.cli import commands
from fedvla_lib.config import PROFILES, Config
from fedvla_lib.pretraining.recipe import Recipe

CONTINUES = "the same command continues"


class _Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = _Parser(prog="fedvla", description="Federated training of a vision-language-action model.")
    parser.add_argument("--traceback", action="store_true", help="print the traceback of an error")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _command(subparsers, commands.doctor, "check that this machine can run the book")
    _add_record(subparsers)
    _add_pretrain(subparsers)
    _add_experts(subparsers)
    _add_settings(_command(subparsers, commands.config, "print the settings as TOML for flwr run --run-config"))
    _add_train(subparsers)
    _add_run(subparsers)
    _add_deploy(subparsers)
    _add_superlink(subparsers)
    _add_credentials(subparsers)
    _add_evaluate(subparsers)
    _add_experiment(subparsers)
    _add_search(subparsers)
    _add_compare(subparsers)
    _add_videos(subparsers)
    return parser


Handler = Callable[[argparse.Namespace], int | None]


def _command(subparsers: Any, handler: Handler, text: str, kept: str = "nothing was written") -> _Parser:
    """Add the command named like `handler`; `kept` is printed when it is interrupted."""
    parser = subparsers.add_parser(handler.__name__, help=text, description=text[0].upper() + text[1:] + ".")
    parser.set_defaults(handler=handler, kept=kept)
    return parser


def _add_record(subparsers: Any) -> None:
    kept = f"complete episodes are kept, {CONTINUES}"
    parser = _command(subparsers, commands.record, "record expert demonstrations as a LeRobot data set", kept)
    _add_profile(parser)
    _add_tasks(parser, "those of the profile")
    chosen = {"type": int, "default": argparse.SUPPRESS}
    parser.add_argument("--episodes", dest="episodes_per_task", metavar="N", help="demonstrations per task", **chosen)
    text = "the folder to write to (default: the cache, where the chapters find it)"
    parser.add_argument("--out", dest="folder", type=Path, metavar="DIR", help=text)
    text = "side length of the square camera images"
    parser.add_argument("--image-size", metavar="PIXELS", help=text, **chosen)
    parser.add_argument("--num-labs", metavar="N", help="labs to record in, in turn (default: 1)", **chosen)
    parser.add_argument("--seed", help="seed of all episodes", **chosen)


def _add_pretrain(subparsers: Any) -> None:
    kept = f"episodes and checkpoints are in the cache, {CONTINUES}"
    parser = _command(subparsers, commands.pretrain, "pretrain the nano base that comes with this package", kept)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="the folder to write to")
    for field in fields(Recipe):
        flag, text = "--" + field.name.replace("_", "-"), setting_texts(Recipe)[field.name]
        parser.add_argument(flag, default=field.default, type=field.type, metavar=field.type.__name__.upper(),
                            help=f"{text} (default: {field.default})")  # fmt: skip


def _add_experts(subparsers: Any) -> None:
    parser = _command(subparsers, commands.experts, "measure the success rates of the scripted experts")
    _add_tasks(parser, "all")
    parser.add_argument("--episodes", type=int, default=200, metavar="N", help="episodes per task (default: 200)")


def _add_train(subparsers: Any) -> None:
    kept = "checkpoints are in the run folder; fedvla train --resume FOLDER, --client and --steps as before, continues"
    text = "train a policy without federation: on all data, or on one client's partition"
    parser = _command(subparsers, commands.train, text, kept)
    parser.add_argument("--client", type=int, metavar="K", help="train on client K's partition only")
    text = "gradient steps (default: num-server-rounds times local-steps)"
    parser.add_argument("--steps", type=int, metavar="N", help=text)
    _add_resume(parser)
    _add_settings(parser)


def _add_run(subparsers: Any) -> None:
    kept = "completed rounds are in the run folder"
    parser = _command(subparsers, commands.run, "run federated training with simulated clients", kept)
    text = "inline: one client after the other, in this process; simulation: Flower's simulation, in several processes"
    parser.add_argument("--engine", choices=("inline", "simulation"), default="inline", help=text)
    _add_jobs(parser, "inline: clients")
    _add_resume(parser)
    _add_settings(parser)


def _add_deploy(subparsers: Any) -> None:
    kept = "every process is stopped; completed rounds are in the run folder"
    text = "run a federation on a SuperLink and SuperNodes, each a process on this machine"
    parser = _command(subparsers, commands.deploy, text, kept)
    text = "the same as --num-clients"
    parser.add_argument("--clients", type=int, dest="num_clients", default=argparse.SUPPRESS, metavar="N", help=text)
    parser.add_argument("--tls", action="store_true", help="encrypt connections, with certificates made for this run")
    parser.add_argument("--auth", action="store_true", help="accept only nodes with a registered key; needs --tls")
    text = "the folder of one client's own data set; repeat for every client, in order (default: parts of --data)"
    parser.add_argument("--node-data", action="append", type=Path, metavar="DIR", help=text)
    _add_resume(parser)
    _add_settings(parser)


def _add_superlink(subparsers: Any) -> None:
    text = "start, stop or check the SuperLink service for flwr run . local-simulation"
    parser = _command(subparsers, commands.superlink, text, "nothing was started")
    text = "status exits with 3 if it is not up; last reports the newest run, and exits with 2 if that failed"
    parser.add_argument("action", choices=("up", "down", "status", "last"), help=text)


def _add_credentials(subparsers: Any) -> None:
    text = "make certificates and node keys for a deployment on several hosts"
    parser = _command(subparsers, commands.credentials, text)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="the new folder for the files")
    text = "host name or address at which nodes reach the server; repeat for several"
    parser.add_argument("--host", action="append", required=True, metavar="HOST", help=text)
    parser.add_argument("--nodes", type=int, required=True, metavar="N", help="number of nodes; each gets a key")


def _add_evaluate(subparsers: Any) -> None:
    text = "measure the success rates of a saved policy in rollouts"
    parser = _command(subparsers, commands.evaluate, text, "videos written so far are kept")
    parser.add_argument("policy", type=Path, help="a pretrained_model folder, such as <run>/global_model/round_4")
    _add_tasks(parser, "all")
    parser.add_argument("--rollouts", type=int, default=20, metavar="N", help="rollouts per task (default: 20)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="the folder for videos and rows.csv (default: none)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the policy's noise (default: 0)")
    _add_jobs(parser, "groups of rollouts")


def _add_experiment(subparsers: Any) -> None:
    text = "train and measure a grid of methods, partitions and seeds"
    parser = _command(subparsers, commands.experiment, text, f"finished cells are kept, {CONTINUES}")
    parser.add_argument("file", type=Path, help="the plan, a TOML file; see fedvla_lib/experiments/experiment_file.py")
    text = "the folder for the results, a run folder per cell"
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help=text)
    _add_jobs(parser, "cells")


def _add_search(subparsers: Any) -> None:
    text = "tune the settings of a federated run at a fixed budget of gradient steps"
    parser = _command(subparsers, commands.search, text, f"finished trials are kept, {CONTINUES}")
    parser.add_argument("--trials", type=int, default=20, metavar="N", help="settings to try (default: 20)")
    text = "rollouts per task with the first and the best settings (default: 20)"
    parser.add_argument("--rollouts", type=int, default=20, metavar="N", help=text)
    text = "the folder for the trials and the result"
    parser.add_argument("--search-out", type=Path, required=True, metavar="DIR", help=text)
    _add_settings(parser)


def _add_compare(subparsers: Any) -> None:
    text = "compare runs, paired by held-out episode and by rollout"
    parser = _command(subparsers, commands.compare, text)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="run folders; the first is the reference")
    _add_metrics(parser, "loss,action_accuracy,success_rate")
    text = "confidence level of the intervals (default: 0.95)"
    parser.add_argument("--confidence", type=float, default=0.95, help=text)
    parser.add_argument("--seed", type=int, default=42, help="seed of the bootstrap (default: 42)")
    text = "the folder for JSON, CSV and a figure (default: none)"
    parser.add_argument("--out", type=Path, metavar="DIR", help=text)
    text = "compare runs even if data, gradient steps or rollouts differ; the differences are listed"
    parser.add_argument("--allow-mismatch", action="store_true", help=text)


def _add_videos(subparsers: Any) -> None:
    parser = _command(subparsers, commands.videos, "check a run's rollout videos and report metrics by round")
    parser.add_argument("folder", type=Path, help="the evaluate folder of a run")
    _add_metrics(parser, "success_rate,completion_time,action_smoothness")
    parser.add_argument("--who", metavar="NAME", help="only rollouts of global, or of client_K (default: all)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="the folder for CSV and a figure (default: none)")


def _add_tasks(parser: argparse.ArgumentParser, default: str) -> None:
    text = f"name of a task; repeat for several (default: {default})"
    parser.add_argument("--task", action="append", metavar="NAME", help=text)


def _add_jobs(parser: argparse.ArgumentParser, what: str) -> None:
    text = f"{what} at a time, each in a process of its own (default: $FEDVLA_JOBS, else one per core)"
    parser.add_argument("--jobs", type=int, metavar="N", help=text)


def _add_metrics(parser: argparse.ArgumentParser, default: str) -> None:
    text = f"metrics, separated by commas (default: {default})"
    parser.add_argument("--metrics", default=default, metavar="NAMES", help=text)


def _add_resume(parser: argparse.ArgumentParser) -> None:
    text = "run folder of an interrupted run to resume with its own settings"
    parser.add_argument("--resume", type=Path, metavar="RUN_FOLDER", help=text)


def _add_profile(parser: argparse.ArgumentParser) -> None:
    text = f"one of {', '.join(PROFILES)} (default: $FEDVLA_PROFILE, else laptop)"
    parser.add_argument("--profile", metavar="NAME", help=text)


def _add_settings(parser: argparse.ArgumentParser) -> None:
    """Add ``--profile`` and a flag for every setting; only given flags override the profile."""
    _add_profile(parser)
    group = parser.add_argument_group("settings", "every setting of a run; the profile has the defaults")
    texts = setting_texts()
    for field in fields(Config):
        if field.name == "resume":  # a flag of its own, where a run can be resumed
            continue
        flag, text = "--" + field.name.replace("_", "-"), texts[field.name].replace("%", "%%")
        typed = {"type": field.type, "metavar": field.type.__name__.upper()}
        kind = {"action": argparse.BooleanOptionalAction} if field.type is bool else typed
        group.add_argument(flag, default=argparse.SUPPRESS, help=text, **kind)


def setting_texts(settings_class: type = Config) -> dict[str, str]:
    """Return the comment after each field in the source of a settings class."""
    return dict(re.findall(r"^    (\w+): \w+ = .*?  # (.+)$", inspect.getsource(settings_class), flags=re.MULTILINE))
