"""Federated, centralized and every client alone, on the same rollouts, over several seeds.

A seed fixes the partition, the clients drawn, noise and batches; the demonstrations are always the same. The best
client of a run is selected on the same rollouts, which favours it. A client alone takes its share of the gradient
steps, so its rate is what it gets at an equal total, not what it can reach. The steps in the table are those planned
by the settings. Finished seeds are kept and not measured again.

    python benchmarks/four_methods.py
"""

import json
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import replace

import pandas as pd

from fedvla_book.tables.grids import paired_difference
from fedvla_lib.config import Config, granted_cores, task_names
from fedvla_lib.data import recordings
from fedvla_lib.evaluation.rollouts import FIRST_SEED, evaluate, rollout_seeds
from fedvla_lib.evaluation.statistics import success_table
from fedvla_lib.experiments import methods
from fedvla_lib.files import write_json
from fedvla_lib.policy.actor import PolicyActor
from fedvla_lib.policy.model import Bundle
from report import laptop, options, report, start

STARTS_FROM = FIRST_SEED + 1000  # other starting positions than the chapters
BEST, EVERY = ALONE = ("best client alone", "all clients alone")


def main() -> None:
    """Measure and report."""
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="seeds of the runs")
    parser.add_argument("--rollouts", type=int, default=20, help="rollouts per task, model and seed")
    parser.add_argument("--threads", type=int, default=granted_cores(), help="threads per model")
    chosen = parser.parse_args()
    recording = recordings.resolve(laptop(chosen.profile))
    config = laptop(chosen.profile, num_threads=chosen.threads, data=str(recording))
    rows = pd.concat([one_seed(config, seed, chosen) for seed in chosen.seeds], ignore_index=True)
    report("four_methods", summary(rows, config), chosen.out)


def one_seed(config: Config, seed: int, chosen: Namespace) -> pd.DataFrame:
    """Return one row per rollout and model of a run."""
    config = replace(config, seed=seed)
    run = methods.federated(config)
    file = chosen.out / "four_methods" / f"{run.parent.name}_{chosen.rollouts}.json"  # named by settings, base and code
    if not file.is_file():
        starts = rollout_seeds(chosen.rollouts, first=STARTS_FROM)
        rows = [row for name, bundle in models(config) for row in rollouts(name, bundle, config, starts)]
        write_json(file, rows)
    return pd.DataFrame(json.loads(file.read_text())).assign(run=seed)


def rollouts(name: str, bundle: Bundle, config: Config, starts: list[int]) -> list[dict[str, object]]:
    """Return the columns for paired comparisons, one row per rollout of a model."""
    rows = evaluate(PolicyActor(bundle, config.seed), task_names(config), starts, image_size=config.image_size)
    return [{"method": name, "task": row["task"], "seed": row["seed"], "success": row["success"]} for row in rows]


def models(config: Config) -> Iterator[tuple[str, Bundle]]:
    """Yield the name and the model of every method and client."""
    yield "federated", methods.federated_policy(config)
    yield "centralized", methods.centralized(config)
    for client in range(config.num_clients):
        yield f"client_{client} alone", methods.local_only(config, client)


def planned_steps(config: Config) -> dict[str, tuple[int, int]]:
    """Return for each method the gradient steps of one of its models that the settings plan: in all and in a row."""
    total, alone = methods.total_steps(config), methods.steps_per_client(config)
    federated = (total, methods.steps_in_a_row(config))
    return {"federated": federated, "centralized": (total, total)} | dict.fromkeys(ALONE, (alone, alone))


def summary(rows: pd.DataFrame, config: Config) -> list[dict[str, object]]:
    """Return a row per method: steps, successes with interval, and federated's lead on the same rollouts."""
    alone = rows[rows.method.str.endswith(" alone")]
    best = pd.concat(
        [part[part.method == part.groupby("method").success.sum().idxmax()] for _, part in alone.groupby("run")]
    )
    counted = {"federated": rows[rows.method == "federated"], "centralized": rows[rows.method == "centralized"]}
    counted |= {BEST: best, EVERY: alone}
    table, steps = [], planned_steps(config)
    for name, part in counted.items():
        (line,) = success_table(part.assign(method=name), ["method"]).to_dict("records")
        table.append(
            {
                "method": name,
                "steps of a model (by the settings)": steps[name][0],
                "of them in a row": steps[name][1],
                "runs": int(part.run.nunique()),
                "rollouts": int(line["n"]),
                "successes": int(line["successes"]),
                "95 % interval [%]": f"{100 * line['low']:.0f} to {100 * line['high']:.0f}",
                "federated ahead by [points]": ahead_of(name, counted) if name in ("centralized", BEST) else "",
                "behind federated": behind(part, counted["federated"]),
            }
        )
    return table


def ahead_of(name: str, counted: dict[str, pd.DataFrame]) -> str:
    """Return federated's lead over a method, with interval; rollouts are paired by run, task and start."""
    both = pd.concat([counted["federated"], counted[name].assign(method=name)])
    paired = both.assign(task=both.run.astype(str) + both.task)
    result = paired_difference(paired, "federated", name, seed=0)
    return f"{100 * result['difference']:+.0f} ({100 * result['low']:+.0f} to {100 * result['high']:+.0f})"


def behind(part: pd.DataFrame, federated: pd.DataFrame) -> str:
    """Return how many models of a method succeeded less often than the federated model of their run."""
    rates, ours = part.groupby(["run", "method"]).success.mean(), federated.groupby("run").success.mean()
    return f"{sum(rate < ours[run] for (run, _), rate in rates.items())} of {len(rates)}"


if __name__ == "__main__":
    start(main)
