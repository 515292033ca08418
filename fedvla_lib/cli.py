"""`fedvla ...`: thin shells around the library; each command parses, calls and prints.

Bad input ends with one line on stderr and exit status 2, Ctrl-C with a line that says what is kept and status 130;
`kill` and a terminal that is closed count as Ctrl-C.
Heavy packages are imported inside the commands, so that help and settings answer at once.
"""

import argparse
import inspect
import json
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NoReturn

from fedvla_lib.config import PROFILES, Config, Recipe, from_profile, task_names, to_run_config
from fedvla_lib.spec import CAMERAS, image_key

EXPECTED = (ValueError, OSError, RuntimeError, FloatingPointError)  # what the library raises with a message for people
FAILED = 2  # bad input, or a run that failed
DOWN = 3  # as service managers report a service that is not running
DAMAGED = 1  # something was found, and not all of it is sound
LOCAL = "local"  # who acts and is measured where there is no federation
INTERRUPTED = 130  # 128 + SIGINT, as shells report it
ENDINGS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]  # by kill, by the terminal


class _Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    options = build_parser().parse_args(argv)
    try:
        with _ended_as_by_ctrl_c():
            return options.handler(options) or 0
    except KeyboardInterrupt:
        print(f"\ninterrupted: {options.kept}", file=sys.stderr)
        return INTERRUPTED
    except EXPECTED as error:
        if options.traceback:
            traceback.print_exc()
        print(f"fedvla {options.command}: {_one_line(error)}", file=sys.stderr)
        return FAILED


@contextmanager
def _ended_as_by_ctrl_c() -> Iterator[None]:
    """Meanwhile a command that is told to end stops what it has started. What is ignored stays so, as under nohup."""
    on_main_thread = threading.current_thread() is threading.main_thread()  # only there may signals be handled
    signs = [sign for sign in ENDINGS if on_main_thread and signal.getsignal(sign) is signal.SIG_DFL]
    for sign in signs:
        signal.signal(sign, signal.default_int_handler)
    try:
        yield
    finally:
        for sign in signs:
            signal.signal(sign, signal.SIG_DFL)


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
    parser = _command(commands, "experiment", experiment, "train and measure a grid of arms and seeds", kept)
    parser.add_argument("file", type=Path, help="what to measure: a TOML file, see fedvla_lib/experiment.py")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for one result file a cell")


def _add_search(commands: Any) -> None:
    kept = "finished trials are kept, the same command continues"
    parser = _command(commands, "search", search, "search for settings of a federation at equal gradient steps", kept)
    parser.add_argument("--trials", type=int, default=20, metavar="N", help="settings to try (default: 20)")
    parser.add_argument("--rollouts", type=int, default=20, metavar="N", help="attempts at each task (default: 20)")
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
    parser.add_argument("--rollouts", type=int, default=20, metavar="N", help="attempts at each task (default: 20)")
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


def settings(options: argparse.Namespace) -> Config:
    """Return the profile's settings with the given flags on top."""
    names = {field.name for field in fields(Config)} - {"resume"}
    return from_profile(options.profile, **{name: value for name, value in vars(options).items() if name in names})


def doctor(options: argparse.Namespace) -> int:
    """Print the table of checks; 1 if a chapter could not run."""
    from fedvla_lib.doctor import can_run, examine, table

    checks = examine()
    print(table(checks))
    return 0 if can_run(checks) else 1


def record(options: argparse.Namespace) -> None:
    """Record into a folder, or into the cache where the chapters look."""
    from fedvla_lib.record import record as record_episodes

    given = {
        "episodes_per_task": options.episodes,
        "image_size": options.image_size,
        "num_labs": options.num_labs,
        "seed": options.seed,
    }
    chosen = {name: value for name, value in given.items() if value is not None}
    if options.task:
        chosen["tasks"] = ",".join(options.task)
    wanted = from_profile(options.profile, **chosen)
    if options.out is None:
        from fedvla_lib.data import resolve

        print(resolve(wanted))
        return
    kinds = {"image_size": wanted.image_size, "seed": wanted.seed, "num_labs": wanted.num_labs}
    print(record_episodes(task_names(wanted), wanted.episodes_per_task, options.out, **kinds))


def pretrain(options: argparse.Namespace) -> None:
    """Make a nano base and print how often it succeeds at what it has seen, and at what it has not."""
    import pandas as pd

    from fedvla_lib.pretrain import pretrain as make
    from fedvla_lib.pretrain import read_account

    folder = make(Recipe(**{field.name: getattr(options, field.name) for field in fields(Recipe)}), options.out)
    _print_table(pd.DataFrame(read_account(folder)["success"]))
    print(folder)


def experts(options: argparse.Namespace) -> None:
    """Print each expert's success rate with its interval."""
    import pandas as pd
    from tqdm.auto import tqdm

    from fedvla_lib.compare import success_table
    from fedvla_lib.evaluate import rollout_seeds
    from fedvla_lib.expert import expert_success
    from fedvla_lib.tasks import TASKS, check_tasks

    _require_positive("--episodes", options.episodes)
    tasks = check_tasks(options.task or list(TASKS))
    rows = [row for task in tasks for row in expert_success(task, tqdm(rollout_seeds(options.episodes), desc=task))]
    _print_table(success_table(pd.DataFrame(rows), ["task"]))


def config(options: argparse.Namespace) -> None:
    """Print the settings as TOML."""
    for key, value in to_run_config(settings(options)).items():
        print(f"{key} = {json.dumps(value)}")


def train(options: argparse.Namespace) -> None:
    """Train one policy, centrally or as one client alone, into a run folder."""
    from fedvla_lib.run_folder import RunFolder, hold, read_config, read_stamp, start, write_json

    if options.resume:
        root, config = options.resume, read_config(options.resume)
        with hold(root):
            _train_into(RunFolder(root), config, options)
            write_json(root / "stamp.json", {**read_stamp(root), "status": "completed", "resumed": True})
        return
    chosen = settings(options)
    with start(chosen, engine="local") as folder:
        _train_into(folder, chosen, options)


def _train_into(folder: Any, chosen: Config, options: argparse.Namespace) -> None:
    from fedvla_lib import clients, prefix, wire
    from fedvla_lib.model import save_policy
    from fedvla_lib.train import local_train

    learner = _learner(chosen, options.client)
    bundle = clients.load_policy(chosen, wire.pack_stats(learner.statistics()))
    steps = options.steps or chosen.num_server_rounds * chosen.local_steps
    batches, checkpoints = prefix.stored(bundle, learner.batches()), folder.root / "checkpoints"
    resume = options.resume is not None
    result = local_train(bundle, batches, chosen, steps=steps, checkpoint_dir=checkpoints, resume=resume)
    save_policy(bundle, folder.root / "model")
    frames, measured = _measure_into(folder, chosen, learner.store, bundle)
    folder.log(0, LOCAL, "evaluate", {"gradient_steps": result.steps, "num_examples": frames, **measured})
    print(f"{result.steps} steps in {result.seconds:.0f} s, last loss {result.losses[-1]:.3f}")
    print(f"on {frames} held-out frames: " + ", ".join(f"{name} {value:.3f}" for name, value in measured.items()))
    print(folder.root / "model")


def _measure_into(folder: Any, chosen: Config, store: Any, bundle: Any) -> tuple[int, dict[str, float]]:
    """Log held-out measurements and rollouts as a federation does of its global model, and return the averages."""
    from fedvla_lib import clients
    from fedvla_lib.evaluate import rollout_seeds, success_rate
    from fedvla_lib.train import average

    held_out = clients.held_out_episodes(store, chosen)
    frames = clients.held_out_frames(bundle, store, held_out, chosen)
    episodes = clients.by_episode(frames, store, held_out)
    for of_episode in episodes:
        folder.log(0, LOCAL, "held-out", of_episode)
    measured = average(frames) if frames else {}
    if chosen.eval_rollouts:
        seeds = rollout_seeds(chosen.eval_rollouts)
        rows = clients.roll_out(bundle, chosen, seeds, folder.videos_dir(0, LOCAL), True)
        for row in rows:
            folder.log(0, LOCAL, "rollout", {**row, "video": folder.relative(row["video"])})
        measured["success_rate"] = success_rate(rows)
    return sum(of_episode["num_examples"] for of_episode in episodes), measured


def _learner(chosen: Config, client: int | None) -> Any:
    """Return the client that trains: number `client`, or one that holds everything."""
    from fedvla_lib import clients, data

    if client is not None:
        return clients.open_client(chosen, client)
    store = clients.open_frames(chosen)
    return clients.Client(chosen, 0, store, clients.Share(*data.split(store, chosen.val_fraction, chosen.seed)))


def run(options: argparse.Namespace) -> None:
    """Run a federation and print what was measured of the global model, round by round."""
    _print_rounds(_engine(options.engine)(_chosen(options)))


def _chosen(options: argparse.Namespace) -> Config:
    """Return the settings of a new run, or of the one to go on with."""
    return _to_resume(options) if options.resume else settings(options)


def _to_resume(options: argparse.Namespace) -> Config:
    """Return the settings of an interrupted run; with it only what does not change the result may be given.

    Whether it can go on is asked before anything is started for it.
    """
    from fedvla_lib.run_folder import hold, read_config, resumable

    names = {field.name for field in fields(Config)} - {"resume", "num_threads"}
    if given := sorted(names & set(vars(options))):
        raise ValueError(f"--{given[0].replace('_', '-')} cannot be given with --resume: a run keeps its settings")
    if not (options.resume / "config.json").is_file():
        raise ValueError(f"--resume {options.resume}: no run folder there, it has no config.json")
    threads = {"num_threads": options.num_threads} if "num_threads" in vars(options) else {}
    chosen = replace(read_config(options.resume), resume=str(options.resume.resolve()), **threads)
    with hold(options.resume):
        resumable(options.resume, chosen)
    return chosen


def deploy(options: argparse.Namespace) -> None:
    """Run a federation on processes of this machine and print what was measured of the global model."""
    from fedvla_lib.deploy import run_deployed

    data = options.node_data or []
    _print_rounds(run_deployed(_chosen(options), tls=options.tls, auth=options.auth, data=data))


def standing_superlink(options: argparse.Namespace) -> int:
    """Start or stop the SuperLink of the connection file, or say whether it is up, or how its last run ended."""
    from fedvla_lib import standing

    if not os.environ.get("FLWR_HOME"):
        raise ValueError("FLWR_HOME is not set: `. flower/env.sh` first, so that Flower settings of your own stay")
    home = Path(os.environ["FLWR_HOME"])
    if options.action in ("status", "last"):
        asked, otherwise = {"status": (standing.status, DOWN), "last": (standing.last, FAILED)}[options.action]
        is_well, words = asked(home)
        print(words)
        return 0 if is_well else otherwise
    print({"up": standing.up, "down": standing.down}[options.action](home))
    return 0


def make_credentials(options: argparse.Namespace) -> None:
    """Write an authority's and a server's certificate and a key for each node, and say who gets which."""
    from fedvla_lib import credentials

    _require_positive("--nodes", options.nodes)
    if options.out.exists():
        raise ValueError(f"--out {options.out} exists: give a new folder, so that no key is overwritten")
    files = credentials.make_server(options.out / "server", options.host)
    keys = [credentials.make_node_key(options.out / "nodes", f"node_{k}") for k in range(options.nodes)]
    print(f"for the server only: {files.key}\nfor the server: {files.certificate}\nfor all: {files.authority}")
    for k, key in enumerate(keys):
        print(f"for node {k} only: {key.private}; its public half, to be registered: {key.public}")


def _print_rounds(folder: Path) -> None:
    from fedvla_lib.run_folder import read_metrics

    rounds = read_metrics(folder, kind="evaluate")
    _print_table(rounds[rounds.who == "global"].drop(columns=["who", "kind", "time"]))
    print(folder)


def _engine(name: str) -> Callable[[Config], Path]:
    if name == "simulation":
        from fedvla_lib.superlink import run_simulation

        return run_simulation
    from fedvla_lib.engine import run_inline

    return run_inline


def experiment(options: argparse.Namespace) -> None:
    """Measure every cell of an experiment that has no result yet."""
    from fedvla_lib.experiment import read_plan, run_plan
    from fedvla_lib.results import read_results, summary

    run_plan(read_plan(options.file), options.out)
    print(summary(read_results(options.out)).round(3).to_string(index=False))


def search(options: argparse.Namespace) -> None:
    """Search, and print the budget, the winner and what it is worth on what did not choose it."""
    from fedvla_lib.search import search as search_settings

    found = search_settings(settings(options), options.trials, options.rollouts, options.search_out)
    print(f"{len(found['trials'])} trials of {found['budget']} gradient steps each")
    print("winner: " + ", ".join(f"{name.replace('_', '-')}={value:.3g}" for name, value in found["winner"].items()))
    for name in ("start", "best"):
        line = found[name]
        print(f"{name}: held-out loss {line['loss']:.3f}, {line['successes']} of {line['n']} rollouts succeed")
    print(options.search_out / "search.json")


def evaluate(options: argparse.Namespace) -> None:
    """Roll out a saved policy and print its success rates."""
    import pandas as pd

    from fedvla_lib.compare import success_table
    from fedvla_lib.evaluate import evaluate as roll_out
    from fedvla_lib.evaluate import rollout_seeds
    from fedvla_lib.model import PolicyActor, load_policy
    from fedvla_lib.run_folder import write_atomically
    from fedvla_lib.tasks import TASKS, check_tasks

    _require_positive("--rollouts", options.rollouts)
    tasks = check_tasks(options.task or list(TASKS))
    chosen = _saved_settings(options.policy)
    actor = PolicyActor(load_policy(chosen), options.seed)
    seeds, videos = rollout_seeds(options.rollouts), options.out and options.out / "videos"
    rows = pd.DataFrame(roll_out(actor, tasks, seeds, image_size=chosen.image_size, videos_dir=videos))
    if options.out:
        write_atomically(options.out / "rows.csv", rows.to_csv(index=False).encode())
    _print_table(success_table(rows, ["task"]))


def compare(options: argparse.Namespace) -> None:
    """Print what runs measured and how they differ; refuse runs that cannot be compared."""
    from fedvla_lib import compare_runs

    metrics = compare_runs.check_metrics(options.metrics.split(","))
    if len(options.runs) < 2 or len({path.resolve() for path in options.runs}) < len(options.runs):
        raise ValueError(f"runs {', '.join(map(str, options.runs))}: give two or more different run folders")
    if not 0.5 <= options.confidence < 1:
        raise ValueError(f"--confidence {options.confidence} is not usable: give 0.5 or more, below 1")
    runs = [compare_runs.read_run(path) for path in options.runs]
    differ = compare_runs.mismatches(runs, metrics)
    if differ and not options.allow_mismatch:
        raise ValueError(f"not comparable: {'; '.join(differ)} (--allow-mismatch compares what they have in common)")
    chosen = {"seed": options.seed, "confidence": options.confidence}
    tables = {
        "values": compare_runs.values(runs, metrics, **chosen),
        "differences": compare_runs.differences(runs, metrics, **chosen),
    }
    for line in differ:
        print(f"MISMATCH: {line}")
    for table in tables.values():
        _print_table(table)
    if options.out:
        compare_runs.write(options.out, runs, tables, differ)
        print(options.out / "comparison.json")


def videos(options: argparse.Namespace) -> int:
    """Print a table for each measurement, and every damaged file; 1 if there is one."""
    import pandas as pd

    from fedvla_lib import videos as films

    metrics = films.check_metrics(options.metrics.split(","))
    rows, damaged = films.read_videos(options.folder)
    if options.who and len(rows):
        filmed = sorted(set(rows.who))
        if options.who not in filmed:
            raise ValueError(f"--who {options.who} filmed nothing there: choose from {', '.join(filmed)}")
        rows = rows[rows.who == options.who]
    if len(rows):
        table = pd.concat([films.by_round(rows, metric) for metric in metrics], ignore_index=True)
        _print_table(table)
        if options.out:
            films.write(options.out, rows, table, damaged)
            print(options.out / "rounds.csv")
    print(f"{len(rows)} rollouts whose videos are whole, {len(damaged)} damaged files")
    for line in damaged:
        print(f"fedvla videos: {line}", file=sys.stderr)
    return DAMAGED if damaged else 0


def _saved_settings(folder: Path) -> Config:
    """Return settings that load the policy saved in `folder` as it was trained.

    Raises:
        ValueError: no pretrained_model folder, or one without our cameras.
    """
    if not (folder / "config.json").is_file():
        raise ValueError(f"{folder} is not a pretrained_model folder: it has no config.json")
    saved = json.loads((folder / "config.json").read_text())
    shape = saved.get("input_features", {}).get(image_key(CAMERAS[0]), {}).get("shape")
    if not shape:
        raise ValueError(f"{folder} has no camera {CAMERAS[0]!r}: the simulator shows {', '.join(CAMERAS)}")
    chunk = {name: saved[name] for name in ("chunk_size", "n_action_steps")}
    return replace(Config(), base=str(folder), image_size=shape[-1], **chunk)


def _require_positive(flag: str, value: int) -> None:
    if value < 1:
        raise ValueError(f"{flag} {value} is not usable: give 1 or more")


def _print_table(table: Any) -> None:
    from fedvla_lib.compare import p_text
    from fedvla_lib.results import P_VALUES

    rare = dict.fromkeys(P_VALUES, p_text)
    print(table.to_string(index=False, float_format=lambda value: f"{value:.3f}", formatters=rare))


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


if __name__ == "__main__":
    sys.exit(main())
