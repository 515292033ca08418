"""The commands of `fedvla`, each a function with the command's name that calls the library and prints the result.

Heavy packages are imported inside the functions, so that help and settings appear at once.
"""

import argparse
import json
import os
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from fedvla_lib.config import Config, from_profile, split_names, to_run_config
from fedvla_lib.files import write_atomically
from fedvla_lib.pretraining.recipe import Recipe
from fedvla_lib.robot.tasks import TASKS, check_tasks

FAILED = 2  # exit status: bad input, or a run that failed
DOWN = 3  # exit status of service managers for a service that is not running
DAMAGED = 1  # exit status: some of the files are damaged, or data have errors
LOCAL = "local"  # engine, and `who` in measurements, without a federation
SETTINGS = {field.name for field in fields(Config)} - {"resume"}


def settings(options: argparse.Namespace, **overrides: Any) -> Config:
    """Return the settings of the profile, updated with the given flags and `overrides`."""
    given = {name: value for name, value in vars(options).items() if name in SETTINGS}
    return from_profile(options.profile, **given, **overrides)


def doctor(options: argparse.Namespace) -> int:
    """Print the checks of this machine; status 1 if a chapter could not run."""
    from fedvla_lib.cli.doctor import can_run, examine, table

    checks = examine()
    print(table(checks))
    return 0 if can_run(checks) else 1


def record(options: argparse.Namespace) -> None:
    """Record demonstrations into a folder, by default into the cache where the chapters look for them."""
    from fedvla_lib.data import recordings

    chosen = settings(options, **({"tasks": ",".join(options.task)} if options.task else {}))
    print(recordings.record_into(options.folder, chosen) if options.folder else recordings.resolve(chosen))


def pretrain(options: argparse.Namespace) -> None:
    """Pretrain a nano base and print its success rates on pretraining tasks and on unseen ones."""
    import pandas as pd

    from fedvla_lib.pretraining import pretrain

    recipe = Recipe(**{field.name: getattr(options, field.name) for field in fields(Recipe)})
    folder = pretrain.pretrain(recipe, options.out)
    _print_table(pd.DataFrame(pretrain.read_account(folder)["success"]))
    print(folder)


def experts(options: argparse.Namespace) -> None:
    """Print each expert's success rate with its confidence interval."""
    from fedvla_lib.evaluation.rollouts import rollout_seeds
    from fedvla_lib.robot.expert import expert_success

    tasks = check_tasks(options.task or list(TASKS))
    _print_success([row for task in tasks for row in expert_success(task, rollout_seeds(options.episodes))])


def config(options: argparse.Namespace) -> None:
    """Print the settings as TOML."""
    for key, value in to_run_config(settings(options)).items():
        print(f"{key} = {json.dumps(value)}")


def train(options: argparse.Namespace) -> None:
    """Train one policy, on all data or on one client's, into a run folder."""
    from fedvla_lib.run_folder import start

    chosen = _new_or_resumed(options, of_train=True)
    client, steps = _trained_on(options, chosen)
    with start(chosen, engine=LOCAL, client=client, steps=steps) as folder:
        _train_into(folder, chosen, client, steps)


def _trained_on(options: argparse.Namespace, chosen: Config) -> tuple[int | None, int]:
    """Return the client (None: all data) and the number of gradient steps; a resumed training keeps its own."""
    from fedvla_lib.experiments.methods import steps_in_a_row
    from fedvla_lib.run_folder import read_stamp

    if not options.resume:
        return options.client, options.steps or steps_in_a_row(chosen)
    if given := [name for name in ("client", "steps") if getattr(options, name) is not None]:
        raise ValueError(f"--{given[0]} cannot be given with --resume: a training keeps its own")
    stamp = read_stamp(options.resume)
    if "steps" not in stamp:
        raise ValueError(f"--resume {options.resume} does not say for how many steps: start a new training")
    return stamp["client"], stamp["steps"]


def _train_into(folder: Any, chosen: Config, client: int | None, steps: int) -> None:
    from fedvla_lib.evaluation.measure import log_measurement, measure
    from fedvla_lib.evaluation.rollouts import rollout_seeds, tasks_to_roll_out
    from fedvla_lib.experiments.methods import train_alone
    from fedvla_lib.federation.client import open_client, open_pooled
    from fedvla_lib.policy.model import load_policy, save_policy
    from fedvla_lib.policy.training import Checkpoints

    learner = open_pooled(chosen) if client is None else open_client(chosen, client)
    bundle = load_policy(chosen, learner.statistics())
    checkpoints = Checkpoints(folder.root / "checkpoints", resume=bool(chosen.resume))
    result = train_alone(bundle, learner, steps=steps, checkpoints=checkpoints)
    save_policy(bundle, folder.root / "model")
    tasks, why = tasks_to_roll_out(chosen, set(learner.store.episodes.task))
    found = measure(
        bundle, learner.store, replace(chosen, tasks=",".join(tasks)), seeds=rollout_seeds(chosen.eval_rollouts),
        videos_dir=folder.videos_dir(0, LOCAL), progress=True,
    )  # fmt: skip
    log_measurement(folder, 0, LOCAL, found)
    measured = found.averages | found.success()
    folder.log(0, LOCAL, "evaluate", {"gradient_steps": result.steps, "num_examples": found.num_examples} | measured)
    print(f"{result.steps} steps in {result.seconds:.0f} s, last loss {result.losses[-1]:.3f}")
    print(f"on {found.num_examples} held-out frames: " + ", ".join(f"{k} {v:.3f}" for k, v in measured.items()))
    print(*filter(None, [why, folder.root / "model"]), sep="\n")


def run(options: argparse.Namespace) -> None:
    """Run a federation and print the measurements of the global model by round."""
    from fedvla_lib.engines import inline, simulation
    from fedvla_lib.experiments.methods import total_steps

    config = _new_or_resumed(options)
    if options.engine == "simulation":
        return _print_rounds(simulation.run_simulation(config))
    jobs = _jobs(options, config.device) if options.jobs or total_steps(config) >= 400 else 1  # not worth it for fewer
    _print_rounds(inline.run_inline(config, jobs=jobs))


def _new_or_resumed(options: argparse.Namespace, of_train: bool = False) -> Config:
    """Return the settings of a new run, or of the interrupted run to resume.

    Args:
        of_train: the folder has to be of ``fedvla train``, and else of a federation.

    Raises:
        ValueError: the run cannot be resumed, or a setting that changes results was given with ``--resume``.
    """
    from fedvla_lib.data.recordings import with_client_data
    from fedvla_lib.run_folder import hold, read_config, resumable

    if not options.resume:
        return with_client_data(settings(options))
    if given := sorted((SETTINGS - {"num_threads"}) & set(vars(options))):
        raise ValueError(f"--{given[0].replace('_', '-')} cannot be given with --resume: a run keeps its settings")
    if not (options.resume / "config.json").is_file():
        raise ValueError(f"--resume {options.resume} is not a run folder: it has no config.json")
    threads = {"num_threads": options.num_threads} if "num_threads" in vars(options) else {}
    chosen = replace(read_config(options.resume), resume=str(options.resume.resolve()), **threads)
    with hold(options.resume):  # fails here rather than after the engine has started its processes
        stamp = resumable(options.resume, chosen)
    if (stamp["engine"] == LOCAL) != of_train:
        own, other = "fedvla run or deploy", "fedvla train"
        own, other = (other, own) if of_train else (own, other)
        raise ValueError(f"--resume {options.resume} is a folder of {other}: {own} cannot resume it")
    return chosen


def deploy(options: argparse.Namespace) -> None:
    """Run a federation in processes on this machine and print the measurements of the global model by round."""
    from fedvla_lib.engines.deployment import run_deployed

    chosen, data = _new_or_resumed(options), options.node_data or []
    _print_rounds(run_deployed(chosen, tls=options.tls, auth=options.auth, data=data))


def superlink(options: argparse.Namespace) -> int:
    """Start or stop the SuperLink service, or print whether it is up or how its newest run ended."""
    from fedvla_lib.engines import superlink_service as service

    if not os.environ.get("FLWR_HOME"):
        raise ValueError("FLWR_HOME is not set: run `. flower/env.sh` first, so that your own Flower settings are kept")
    home = Path(os.environ["FLWR_HOME"])
    if options.action in ("up", "down"):
        print({"up": service.up, "down": service.down}[options.action](home))
        return 0
    check, exit_status = {"status": (service.status, DOWN), "last": (service.last, FAILED)}[options.action]
    ok, message = check(home)
    print(message)
    return 0 if ok else exit_status


def credentials(options: argparse.Namespace) -> None:
    """Write certificates of an authority and a server, and a key for each node; print who gets which file."""
    from fedvla_lib.engines.credentials import make_node_key, make_server

    if options.out.exists():
        raise ValueError(f"--out {options.out} exists: give a new folder, so that no key is overwritten")
    server = make_server(options.out / "server", options.host)
    print(f"for the server only: {server.key}\nfor the server: {server.certificate}\nfor all: {server.authority}")
    for k in range(options.nodes):
        key = make_node_key(options.out / "nodes", f"node_{k}")
        print(f"for node {k} only: {key.private}; its public key, to be registered: {key.public}")


def _print_rounds(folder: Path) -> None:
    from fedvla_lib.run_folder import read_config, read_metrics

    rounds = read_metrics(folder, kind="evaluate").drop(columns=["kind", "time"])
    _print_table(rounds[rounds.who == "global"].drop(columns="who").dropna(axis="columns", how="all"))
    if read_config(folder).client_data:  # each measures the global model on its own held-out episodes
        clients = rounds[(rounds.who != "global") & (rounds["round"] == rounds["round"].max())]
        _print_table(clients.dropna(axis="columns", how="all"))
    print(*read_metrics(folder, kind="note").get("detail", []), folder, sep="\n")


def export(options: argparse.Namespace) -> None:
    """Copy a saved policy for LeRobot's commands and print its folder."""
    from fedvla_lib.policy.portable import export as write_export

    print(write_export(options.policy, options.place, options.out))


def experiment(options: argparse.Namespace) -> None:
    """Run the unfinished cells of an experiment and print what each cell reached and cost."""
    import pandas as pd

    from fedvla_lib.experiments.experiment import run_plan
    from fedvla_lib.experiments.experiment_file import read_plan

    plan = read_plan(options.file)
    run_plan(plan, options.out, jobs=_jobs(options, next((cell.config.device for cell in plan.cells), "cpu")))
    _print_table(pd.DataFrame([_of_cell(options.out / cell.name) for cell in plan.cells]))


def _of_cell(folder: Path) -> dict[str, Any]:
    """Return how often the last model of a finished cell succeeded, and what its training cost."""
    from fedvla_lib.evaluation.statistics import mean_with_interval
    from fedvla_lib.run_folder import read_metrics, read_stamp

    stamp, rows = read_stamp(folder), read_metrics(folder, "rollout")
    success = rows.success[rows["round"] == rows["round"].max()].to_numpy(float)
    found = mean_with_interval(success, of_success=True, seed=0)
    costs = {name: stamp[name] for name in ("gradient_steps", "samples", "train_s")}
    names = {name: stamp[name] for name in ("partition", "method", "seed")}
    return {**names, **found, **costs, "MB": stamp["bytes"] / 1e6}


def _jobs(options: argparse.Namespace, device: str) -> int:
    from fedvla_lib.workers import default_jobs

    return options.jobs or default_jobs(device)


def evaluate(options: argparse.Namespace) -> None:
    """Roll out a saved policy and print its success rates by task."""
    from fedvla_lib.evaluation import rollouts
    from fedvla_lib.policy import portable
    from fedvla_lib.policy.actor import PolicyActor
    from fedvla_lib.policy.model import load_policy

    tasks = check_tasks(options.task or list(TASKS))
    chosen = portable.saved_settings(options.policy)
    actor = PolicyActor(load_policy(chosen), options.seed)
    seeds, videos = rollouts.rollout_seeds(options.rollouts), options.out and options.out / "videos"
    settings_of = {"image_size": chosen.image_size, "videos_dir": videos, "jobs": _jobs(options, chosen.device)}
    rows = rollouts.evaluate(actor, tasks, seeds, **settings_of)
    _print_success(rows, options.out and options.out / "rows.csv")


def compare(options: argparse.Namespace) -> None:
    """Print the measurements of runs and their differences; runs that are not comparable are an error."""
    from fedvla_lib.evaluation import compare_runs, statistics

    metrics = statistics.check_metrics(split_names(options.metrics), compare_runs.METRICS)
    if len(options.runs) < 2 or len({path.resolve() for path in options.runs}) < len(options.runs):
        raise ValueError(f"runs {', '.join(map(str, options.runs))}: give two or more different run folders")
    if not 0.5 <= options.confidence < 1:
        raise ValueError(f"--confidence {options.confidence} is not usable: give 0.5 or more, below 1")
    runs = [compare_runs.read_run(path) for path in options.runs]
    differ = compare_runs.mismatches(runs, metrics)
    if differ and not options.allow_mismatch:
        raise ValueError(f"not comparable: {'; '.join(differ)} (--allow-mismatch compares what they have in common)")
    intervals = {"seed": options.seed, "confidence": options.confidence}
    tables = {
        "values": compare_runs.values(runs, metrics, **intervals),
        "differences": compare_runs.differences(runs, metrics, **intervals),
    }
    for line in differ:
        print(f"MISMATCH: {line}")
    for table in tables.values():
        _print_table(table)
    if options.out:
        compare_runs.write(options.out, runs, tables, differ)
        print(options.out / "comparison.json")


def videos(options: argparse.Namespace) -> int:
    """Print the metrics of rollout videos by round and every damaged file; status 1 if there is one."""
    import pandas as pd

    from fedvla_lib.evaluation import statistics, video_report

    metrics = statistics.check_metrics(split_names(options.metrics), video_report.METRICS)
    rows, damaged = video_report.read_videos(options.folder)
    if options.who and len(rows):
        if options.who not in (names := sorted(set(rows.who))):
            raise ValueError(f"--who {options.who} has no video there: choose from {', '.join(names)}")
        rows = rows[rows.who == options.who]
    if len(rows):
        table = pd.concat([video_report.trend_by_round(rows, metric) for metric in metrics], ignore_index=True)
        _print_table(table)
        if options.out:
            video_report.write(options.out, rows, table, damaged)
            print(options.out / "rounds.csv")
    print(f"{len(rows)} rollouts with intact videos, {len(damaged)} damaged files")
    for line in damaged:
        print(f"fedvla videos: {line}", file=sys.stderr)
    return DAMAGED if damaged else 0


def _print_success(rows: list[dict[str, Any]], csv: Path | None = None) -> None:
    """Print success rates by task, and write the rollouts to a file if one is given."""
    import pandas as pd

    from fedvla_lib.evaluation.statistics import success_table

    table = pd.DataFrame(rows)
    if csv:
        write_atomically(csv, table.to_csv(index=False).encode())
    _print_table(success_table(table, ["task"]))


def _print_table(table: Any) -> None:
    from fedvla_lib.evaluation.statistics import P_VALUES, p_text

    formats = dict.fromkeys(P_VALUES, p_text)
    print(table.to_string(index=False, float_format="{:.3f}".format, formatters=formats))
