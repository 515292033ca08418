"""The commands of `fedvla`: thin shells around the library; each parses, calls and prints.

Heavy packages are imported inside the commands, so that help and settings answer at once.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from fedvla_lib.config import Config, from_profile, task_names, to_run_config
from fedvla_lib.pretraining.recipe import Recipe
from fedvla_lib.robot.spec import CAMERAS, image_key

FAILED = 2  # bad input, or a run that failed
DOWN = 3  # as service managers report a service that is not running
DAMAGED = 1  # something was found, and not all of it is sound
LOCAL = "local"  # who acts and is measured where there is no federation


def settings(options: argparse.Namespace) -> Config:
    """Return the profile's settings with the given flags on top."""
    names = {field.name for field in fields(Config)} - {"resume"}
    return from_profile(options.profile, **{name: value for name, value in vars(options).items() if name in names})


def doctor(options: argparse.Namespace) -> int:
    """Print the table of checks; 1 if a chapter could not run."""
    from fedvla_lib.cli.doctor import can_run, examine, table

    checks = examine()
    print(table(checks))
    return 0 if can_run(checks) else 1


def record(options: argparse.Namespace) -> None:
    """Record into a folder, or into the cache where the chapters look."""
    from fedvla_lib.data.record import record as record_episodes

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
        from fedvla_lib.data.recordings import resolve

        print(resolve(wanted))
        return
    kinds = {"image_size": wanted.image_size, "seed": wanted.seed, "num_labs": wanted.num_labs}
    print(record_episodes(task_names(wanted), wanted.episodes_per_task, options.out, **kinds))


def pretrain(options: argparse.Namespace) -> None:
    """Make a nano base and print how often it succeeds at what it has seen, and at what it has not."""
    import pandas as pd

    from fedvla_lib.pretraining.pretrain import pretrain as make
    from fedvla_lib.pretraining.pretrain import read_account

    folder = make(Recipe(**{field.name: getattr(options, field.name) for field in fields(Recipe)}), options.out)
    _print_table(pd.DataFrame(read_account(folder)["success"]))
    print(folder)


def experts(options: argparse.Namespace) -> None:
    """Print each expert's success rate with its interval."""
    import pandas as pd
    from tqdm.auto import tqdm

    from fedvla_lib.evaluation.rollouts import rollout_seeds
    from fedvla_lib.evaluation.statistics import success_table
    from fedvla_lib.robot.expert import expert_success
    from fedvla_lib.robot.tasks import TASKS, check_tasks

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
    from fedvla_lib.files import write_json
    from fedvla_lib.run_folder import RunFolder, hold, read_config, read_stamp, start

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
    from fedvla_lib.evaluation.measure import log_measurement, measure
    from fedvla_lib.evaluation.rollouts import rollout_seeds
    from fedvla_lib.experiments.methods import train_alone
    from fedvla_lib.federation.client import open_client, open_pooled
    from fedvla_lib.policy.model import load_policy, save_policy
    from fedvla_lib.policy.training import Checkpoints

    learner = open_pooled(chosen) if options.client is None else open_client(chosen, options.client)
    bundle = load_policy(chosen, learner.statistics())
    steps = options.steps or chosen.num_server_rounds * chosen.local_steps
    checkpoints = Checkpoints(folder.root / "checkpoints", resume=options.resume is not None)
    result = train_alone(bundle, learner, steps=steps, checkpoints=checkpoints)
    save_policy(bundle, folder.root / "model")
    found = measure(
        bundle, learner.store, chosen, seeds=rollout_seeds(chosen.eval_rollouts),
        videos_dir=folder.videos_dir(0, LOCAL), progress=True,
    )  # fmt: skip
    log_measurement(folder, 0, LOCAL, found)
    measured = found.averages | found.success()
    counted = {"gradient_steps": result.steps, "num_examples": found.num_examples}
    folder.log(0, LOCAL, "evaluate", counted | measured)
    print(f"{result.steps} steps in {result.seconds:.0f} s, last loss {result.losses[-1]:.3f}")
    print(f"on {found.num_examples} held-out frames: " + ", ".join(f"{k} {v:.3f}" for k, v in measured.items()))
    print(folder.root / "model")


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
    from fedvla_lib.engines.deployment import run_deployed

    data = options.node_data or []
    _print_rounds(run_deployed(_chosen(options), tls=options.tls, auth=options.auth, data=data))


def standing_superlink(options: argparse.Namespace) -> int:
    """Start or stop the SuperLink of the connection file, or say whether it is up, or how its last run ended."""
    from fedvla_lib.engines import superlink_service

    if not os.environ.get("FLWR_HOME"):
        raise ValueError("FLWR_HOME is not set: `. flower/env.sh` first, so that Flower settings of your own stay")
    home = Path(os.environ["FLWR_HOME"])
    if options.action in ("status", "last"):
        asked, otherwise = {"status": (superlink_service.status, DOWN), "last": (superlink_service.last, FAILED)}[
            options.action
        ]
        is_well, words = asked(home)
        print(words)
        return 0 if is_well else otherwise
    print({"up": superlink_service.up, "down": superlink_service.down}[options.action](home))
    return 0


def make_credentials(options: argparse.Namespace) -> None:
    """Write an authority's and a server's certificate and a key for each node, and say who gets which."""
    from fedvla_lib.engines import credentials

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
        from fedvla_lib.engines.simulation import run_simulation

        return run_simulation
    from fedvla_lib.engines.inline import run_inline

    return run_inline


def experiment(options: argparse.Namespace) -> None:
    """Measure every cell of an experiment that has no result yet."""
    from fedvla_lib.experiments.experiment import run_plan
    from fedvla_lib.experiments.plan import read_plan
    from fedvla_lib.experiments.results import read_results, summary

    run_plan(read_plan(options.file), options.out)
    print(summary(read_results(options.out)).round(3).to_string(index=False))


def search(options: argparse.Namespace) -> None:
    """Search, and print the budget, the winner and what it is worth on what did not choose it."""
    from fedvla_lib.experiments.search import search as search_settings

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

    from fedvla_lib.evaluation.rollouts import evaluate as roll_out
    from fedvla_lib.evaluation.rollouts import rollout_seeds
    from fedvla_lib.evaluation.statistics import success_table
    from fedvla_lib.files import write_atomically
    from fedvla_lib.policy.actor import PolicyActor
    from fedvla_lib.policy.model import load_policy
    from fedvla_lib.robot.tasks import TASKS, check_tasks

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
    from fedvla_lib.evaluation import compare_runs, statistics

    metrics = statistics.check_metrics(options.metrics.split(","), compare_runs.METRICS)
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

    from fedvla_lib.evaluation import statistics, video_report

    metrics = statistics.check_metrics(options.metrics.split(","), video_report.METRICS)
    rows, damaged = video_report.read_videos(options.folder)
    if options.who and len(rows):
        filmed = sorted(set(rows.who))
        if options.who not in filmed:
            raise ValueError(f"--who {options.who} filmed nothing there: choose from {', '.join(filmed)}")
        rows = rows[rows.who == options.who]
    if len(rows):
        table = pd.concat([video_report.trend_by_round(rows, metric) for metric in metrics], ignore_index=True)
        _print_table(table)
        if options.out:
            video_report.write(options.out, rows, table, damaged)
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
    from fedvla_lib.evaluation.statistics import p_text
    from fedvla_lib.experiments.results import P_VALUES

    rare = dict.fromkeys(P_VALUES, p_text)
    print(table.to_string(index=False, float_format=lambda value: f"{value:.3f}", formatters=rare))
