"""Hyperparameter search for federated runs at a fixed budget of gradient steps, with Optuna.

Trials are selected by held-out loss on one half of the validation episodes. The winner and the settings that the search
started from are reported on the other half and on rollouts that no trial used.
"""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from fedvla_lib import provenance
from fedvla_lib.config import Config, check
from fedvla_lib.data import recordings, splits
from fedvla_lib.evaluation import measure
from fedvla_lib.evaluation.rollouts import roll_out, rollout_seeds
from fedvla_lib.experiments import methods
from fedvla_lib.experiments.experiment import with_recording
from fedvla_lib.experiments.experiment_file import QUIET
from fedvla_lib.federation.nodes import TooFewReplies, sample_size
from fedvla_lib.files import write_json
from fedvla_lib.policy.model import Bundle

# First rollout seed of reports. Not used by chapters; comparison.toml and normalisation.toml share it. Trials make no
# rollouts, so these rollouts select nothing.
ROLLOUTS_FROM = 3_000_000
LOCAL_STEPS, SHARES = (1, 2, 5, 10, 20), (0.1, 0.2, 0.4, 1.0)
# A client raises if its loss is not finite, and the server stops when too few replies are usable.
DIVERGED = (FloatingPointError, TooFewReplies)


def search(config: Config, trials: int, rollouts: int, out: Path) -> dict[str, Any]:
    """Run trials, measure the best and the given settings, and return and write the results.

    A trial that diverges counts, without a loss.

    Args:
        config: the settings to start from; their total of gradient steps is the budget of each trial.
        trials: number of trials, including those of earlier calls with the same `out`.
        rollouts: rollouts per task for the winner and the given settings.
        out: folder for the journal of trials, which a later call resumes, and for ``search.json``.

    Raises:
        ValueError: fewer than one trial or two validation episodes, `out` holds a search with other settings, or every
            trial diverged.
    """
    if trials < 1:
        raise ValueError(f"trials={trials} is not usable: give a number above 0")
    given = replace(config, **QUIET, validate_every=10**6)
    config, out = with_recording(given), Path(out)
    if (count := len(splits.held_out_episodes(recordings.open_frames(config), config))) < 2:
        raise ValueError(
            f"val-fraction={config.val_fraction} leaves {count} validation episodes: a search needs 2 or more, half to "
            "select by and half to report on"
        )
    study = _run_trials(config, trials, out)
    result = {
        "budget": methods.total_steps(config),
        "trials": [
            {"number": trial.number, **trial.params, "selection_loss": trial.value}
            for trial in study.trials if trial.state.is_finished()
        ],
        "winner": study.best_params, "selection_loss": study.best_value,
        "start": report(config, rollouts), "best": report(suggest(study.best_trial, config), rollouts),
        "first_rollout_seed": ROLLOUTS_FROM, "config": asdict(given),
        "stamp": provenance.first_stamp(given, "search") | {"status": "completed", "code": methods.trained_by()},
    }  # fmt: skip
    write_json(out / "search.json", result)
    return result


def _run_trials(config: Config, trials: int, out: Path) -> optuna.Study:
    study = _open(config, out)
    missing = trials - len(study.get_trials(states=[TrialState.COMPLETE, TrialState.FAIL]))

    def selection_loss(trial: optuna.Trial) -> float:
        tried = suggest(trial, config)
        return _loss(methods.federated_policy(tried), tried, 0)

    study.optimize(selection_loss, n_trials=max(0, missing), show_progress_bar=True, catch=DIVERGED)
    if not study.get_trials(states=[TrialState.COMPLETE]):
        raise ValueError(f"all {len(study.trials)} trials in {out} diverged: start from a lower lr than {config.lr}")
    return study


def suggest(trial: Any, config: Config) -> Config:
    """Return the settings of a trial: learning rate, local steps, clients per round, strategy settings."""
    local_steps = trial.suggest_categorical("local_steps", LOCAL_STEPS)
    share = trial.suggest_categorical("fraction_train", SHARES)
    rate = trial.suggest_float("lr", 2e-4, 5e-3, log=True)
    settings = {"lr": rate, "local_steps": local_steps, "fraction_train": share}
    if config.strategy in ("fedavgm", "fedadam", "fedyogi"):
        settings["server_lr"] = trial.suggest_float("server_lr", 1e-3, 2.0, log=True)
    if config.strategy == "fedprox":
        settings["proximal_mu"] = trial.suggest_float("proximal_mu", 1e-3, 10.0, log=True)
    steps_per_round = local_steps * sample_size(share, config.num_clients)
    settings["num_server_rounds"] = max(1, methods.total_steps(config) // steps_per_round)
    return check(replace(config, **settings))


def report(config: Config, rollouts: int) -> dict[str, Any]:
    """Measure settings on data that did not select them: the other validation episodes, and rollouts."""
    bundle = methods.federated_policy(config)
    rows = roll_out(bundle, config, rollout_seeds(rollouts, first=ROLLOUTS_FROM))
    return {
        "loss": _loss(bundle, config, 1), "gradient_steps": methods.total_steps(config),
        "n": len(rows), "successes": sum(row["success"] for row in rows),
    }  # fmt: skip


def _loss(bundle: Bundle, config: Config, half: int) -> float:
    """Held-out loss on every second validation episode, from the first (half 0) or the second (half 1)."""
    store = recordings.open_frames(config)
    episodes = splits.held_out_episodes(store, config)[half::2]
    return measure.measure(bundle, store, config, episode_ids=episodes).averages["loss"]


def _open(config: Config, out: Path) -> optuna.Study:
    out.mkdir(parents=True, exist_ok=True)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = JournalStorage(JournalFileBackend(str(out / "trials.log")))
    study = optuna.create_study(storage=storage, study_name="search", load_if_exists=True)
    # A resumed search must not repeat its draws.
    study.sampler = optuna.samplers.TPESampler(seed=config.seed + len(study.trials))
    settings = json.dumps(asdict(replace(config, data="", num_threads=0)))
    if study.user_attrs.get("settings", settings) != settings:
        raise ValueError(f"{out} holds a search with other settings: give another folder")
    study.set_user_attr("settings", settings)
    return study
