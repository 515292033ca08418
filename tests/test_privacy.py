"""Clipping, noise and the accountant: on small arrays with Flower's messages, and in whole runs of the real policy."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flwr.app import ConfigRecord, Context, Message, MetricRecord, RecordDict
from flwr.clientapp import ClientApp
from flwr.serverapp.strategy import FedAvg
from scipy.stats import norm

from fedvla_lib import run_folder
from fedvla_lib.config import STRATEGIES, Config, check, from_profile
from fedvla_lib.engines import inline
from fedvla_lib.engines.inline import FIRST_NODE_ID, InlineGrid, claim_identity
from fedvla_lib.federation import accountant, client_app, messages, privacy, secure_aggregation
from fedvla_lib.federation.accountant import BudgetSpent, Ledger
from fedvla_lib.federation.nodes import Roster, TooFewReplies
from fedvla_lib.federation.strategies import build
from fedvla_lib.policy.parameters import digest, shapes_of
from test_federation import NO_ROLLOUTS, global_weights, same

pytestmark = pytest.mark.unit
SIZE = 20_000
EACH = ("fedexp", "fedmedian", "krum")  # strategies that look at each update: only clients can add noise for them
PRIVATE = {"noise": 0.5, "clip_norm": 2.0, "normalisation": "none"}


@pytest.fixture(autouse=True)
def identity():
    claim_identity()


def served(tmp_path, updates, rounds=1, examples=1, **settings):
    """Run rounds in which client k sends `updates[k]`; return the global vector, starting at 0, and the events."""
    app, events = ClientApp(), []

    @app.train()
    def train(message: Message, context: Context) -> Message:
        k = context.node_config["partition-id"]
        arrays = messages.unpack_arrays(message.content[messages.ARRAYS])
        arrays = {"w": (arrays["w"] + updates[k]).astype(np.float32)}
        metrics = {messages.EXAMPLES: examples, messages.STEPS: 1, "loss": 0.0, "seconds": 0.0}
        note = ConfigRecord({messages.DIGEST: digest(arrays), **messages.round_of(message.content)})
        content = {messages.ARRAYS: messages.pack_arrays(arrays), messages.METRICS: MetricRecord(metrics)}
        return Message(RecordDict(content | {messages.NOTE: note}), reply_to=message)

    tmp_path.mkdir(exist_ok=True)
    grid = InlineGrid(app, len(updates), {})
    config = Config(**{"num_clients": len(updates), "fraction_train": 1.0, **settings})
    arrays = {"w": np.zeros_like(updates[0], dtype=np.float32)}
    strategy = build.build_strategy(
        config, roster=Roster({node: node - FIRST_NODE_ID for node in grid.get_node_ids()}), shapes=shapes_of(arrays),
        report=lambda *event: events.append(event), keep_rollouts=lambda *_: None,
    )  # fmt: skip
    strategy.ledger = Ledger(config, tmp_path, strategy.size, len(updates)) if config.noise else None
    record = messages.pack_arrays(arrays)
    for number in range(1, rounds + 1):
        sent = strategy.configure_train(number, record, ConfigRecord(), grid)
        record, _ = strategy.aggregate_train(number, grid.send_and_receive(sent))
    return messages.unpack_arrays(record)["w"], [values for _, _, kind, values in events if kind == "privacy"]


def directions(count, lengths=1.0, size=SIZE):
    rows = np.random.default_rng(3).normal(size=(count, size))
    return np.asarray(lengths).reshape(-1, 1) * rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_without_noise_and_clipping_the_average_is_flowers_bit_for_bit(tmp_path):
    updates = directions(5, size=50)
    ours, events = served(tmp_path, updates)
    replies = [
        Message(RecordDict({messages.ARRAYS: messages.pack_arrays({"w": u.astype(np.float32)}),
                            messages.METRICS: MetricRecord({messages.EXAMPLES: 1})}),
                dst_node_id=1, message_type="train") for u in updates
    ]  # fmt: skip
    theirs, _ = FedAvg(weighted_by_key=messages.EXAMPLES).aggregate_train(1, replies)
    assert np.array_equal(ours, theirs["w"].numpy()) and not events


@pytest.mark.parametrize("strategy", ["fedavg", "fedprox"])
def test_noise_on_the_mean_has_the_deviation_that_the_settings_say(tmp_path, strategy):
    updates = directions(4, [0.5, 1.0, 3.0, 30.0])
    found, events = served(tmp_path, updates, strategy=strategy, **PRIVATE)
    wanted = (updates[0] + updates[1] + updates[2] * 2 / 3 + updates[3] * 2 / 30) / 4
    noise = 4 * (found - wanted)
    assert noise.std() == pytest.approx(0.5 * 2.0, rel=0.03)
    assert abs(noise.mean()) < 4 / math.sqrt(SIZE)
    assert events[0]["clipped"] == 2 and events[0]["releases"] == 1


def test_a_client_alone_adds_all_of_the_noise_and_its_neighbour_another():
    config, payload = Config(**PRIVATE, noise_by="client"), {"arrays": {"w": np.zeros(SIZE, np.float32)}}
    first, again, other = (privacy.from_client(payload, config, 1, k)["arrays"]["w"] for k in (0, 0, 1))
    assert first.std() == pytest.approx(1.0, rel=0.03) and np.array_equal(first, again)
    assert abs(np.corrcoef(first, other)[0, 1]) < 0.05
    secret = replace(config, secret_noise=True)
    one, two = (privacy.from_client(payload, secret, 1, 0)["arrays"]["w"] for _ in range(2))
    assert not np.array_equal(one, two)


def test_clipping_counts_all_records_of_a_payload_together_and_leaves_a_client_that_did_not_move():
    payload = {"arrays": {"w": np.full(3, 4.0, np.float32)}, "control": {"w": np.full(1, 1.0, np.float32)}}
    short = privacy.clipped(payload, 3.5)
    assert privacy.norm(payload) == pytest.approx(7) and privacy.norm(short) == pytest.approx(3.5)
    assert short["control"]["w"][0] == pytest.approx(0.5)
    wild = {"arrays": {"w": np.array([1e6, np.nan], np.float32)}}
    assert privacy.norm(privacy.clipped(wild, 1.0)) == 0
    still = {"arrays": {"w": np.zeros(3, np.float32)}}
    assert privacy.clipped(still, 1.0) is still


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_adaptive_clipping_finds_a_quantile(tmp_path, noise):
    lengths = np.exp(np.random.default_rng(1).normal(size=80))
    updates = directions(80, lengths, size=4)
    settings = {"clip_norm": 0.1, "clip_quantile": 0.7, "noise": noise, "normalisation": "none"}
    _, events = served(tmp_path, updates, rounds=60, **settings)
    limits = [event["clip_norm"] for event in events]
    assert limits[0] == 0.1 and np.mean(limits[-20:]) == pytest.approx(np.quantile(lengths, 0.7), rel=0.12)


def test_noise_for_the_count_is_taken_out_of_the_same_budget():
    """Sum and count are one Gaussian release: a client moves the count by 1 and the sum by the clipping norm."""
    for noise, clients in ((1.0, 100), (1.0, 10), (50.0, 10)):
        beside, count = privacy.noise_beside_count(noise, clients), privacy.count_noise(noise, clients)
        assert beside**-2 + count**-2 == pytest.approx(noise**-2)


def test_adaptive_clipping_adds_more_noise_to_the_sum_and_some_to_the_count(tmp_path):
    settings = {**PRIVATE, "clip_quantile": 0.5}
    found, _ = served(tmp_path, np.zeros((4, SIZE)), **settings)
    assert 4 * found.std() == pytest.approx(2.0 * privacy.noise_beside_count(0.5, 4), rel=0.03)
    _, events = served(tmp_path / "many", np.zeros((4, 4)), rounds=300, **settings)
    steps = np.diff(np.log([event["clip_norm"] for event in events]))
    assert steps.std() == pytest.approx(privacy.RATE * privacy.count_noise(0.5, 4) / 4, rel=0.15)


# Noise multipliers for epsilon 8 at delta N^-1.1 after 10 rounds of all clients, from Renyi accounting.
@pytest.mark.parametrize(("clients", "noise"), [(10, 1.19), (100, 1.47), (1000, 1.71)])
def test_the_accountant_gives_known_values(clients, noise):
    config = Config(num_clients=clients, noise=noise, fraction_train=1.0)
    assert accountant.epsilon(config, 10, SIZE) == pytest.approx(8.0, rel=0.01)


@pytest.mark.parametrize(("noise", "releases"), [(1.0, 1), (2.0, 10), (4.0, 100)])
def test_the_accountant_is_above_the_exact_value_and_near_it(noise, releases):
    """Balle and Wang 2018, https://arxiv.org/abs/1805.06530, theorem 8, for the Gaussian mechanism."""
    config = Config(noise=noise, delta=1e-5)
    found, mu = accountant.epsilon(config, releases, SIZE), math.sqrt(releases) / noise

    def exact_delta(epsilon):
        return norm.cdf(mu / 2 - epsilon / mu) - math.exp(epsilon) * norm.cdf(-mu / 2 - epsilon / mu)

    assert exact_delta(found) <= 1e-5 < exact_delta(0.85 * found)


def test_sampling_that_stays_secret_amplifies_and_needs_many_clients():
    config = Config(num_clients=1000, fraction_train=0.01, noise=2.0, secret_noise=True)
    assert accountant.epsilon_sampled(config, 10, 1000) < 0.5 * accountant.epsilon(config, 10, SIZE)
    assert accountant.epsilon(config, 0, SIZE) == 0.0
    assert privacy.hides_sampling(config)
    for spoilt in ({"secret_noise": False}, {"sampling": "by-task"}, {"keep_optimizer": True}, {"exchange": "int8"}):
        assert not privacy.hides_sampling(replace(config, **spoilt))


def test_noise_added_together_costs_as_much_as_gaussian_noise():
    """On a grid this fine, the difference of Poisson numbers is as good as Gaussian noise."""
    config = Config(num_clients=10, fraction_train=1.0, noise=1.2, clip_norm=3.0)
    together = replace(config, noise_by="together", secure_aggregation=True)
    gauss, skellam = accountant.epsilon(config, 10, 400_000), accountant.epsilon(together, 10, 400_000)
    assert gauss < skellam < 1.05 * gauss
    coarse = accountant.skellam_rdp(np.array([2.0, 8.0]), 1.2, 3.0, 400_000)
    assert (coarse > 100 * np.array([2.0, 8.0]) / (2 * 1.2**2)).all()  # rounding to three steps is a large part


def test_a_run_beyond_its_budget_does_not_start_and_the_advice_works():
    config = Config(**PRIVATE, num_clients=10, num_server_rounds=10, epsilon_budget=8.0)
    with pytest.raises(ValueError, match="epsilon-budget=8 is not enough") as refused:
        accountant.check_budget(config, SIZE)
    words = str(refused.value).replace(",", " ").split()
    noise, rounds = (next(w for w in words[::-1] if w.startswith(name)) for name in ("noise=", "num-server-rounds="))
    accountant.check_budget(replace(config, noise=float(noise[6:])), SIZE)
    accountant.check_budget(replace(config, num_server_rounds=int(rounds[18:])), SIZE)
    with pytest.raises(ValueError, match="is not enough"):
        accountant.check_budget(replace(config, num_server_rounds=int(rounds[18:]) + 1), SIZE)


def test_releases_are_counted_over_resumes_and_stop_at_the_budget(tmp_path):
    config = Config(**PRIVATE, num_clients=10, epsilon_budget=20.0)
    spent = [Ledger(config, tmp_path, SIZE, 10).spend()["epsilon"]]
    with pytest.raises(BudgetSpent, match="more than epsilon-budget=20"):
        for _ in range(30):
            spent.append(Ledger(config, tmp_path, SIZE, 10).spend()["epsilon"])
    assert spent == sorted(spent) and spent[-1] <= 20.0
    assert json.loads((tmp_path / accountant.SPENT_FILE).read_text())["releases"] == len(spent)


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"noise": 1.0}, "clip-norm=0.0"),
        ({**PRIVATE, "normalisation": "pooled"}, "normalisation='pooled'"),
        ({**PRIVATE, "strategy": "krum"}, "strategy='krum'"),
        ({**PRIVATE, "strategy": "fedexp"}, "strategy='fedexp'"),
        ({**PRIVATE, "noise_by": "client"}, "fraction-evaluate=1.0"),
        ({**PRIVATE, "noise_by": "client", "fraction_evaluate": 0.0, "sampling": "by-task"}, "sampling='by-task'"),
        ({**PRIVATE, "noise_by": "together", "fraction_evaluate": 0.0}, "noise-by='together'"),
        ({**PRIVATE, "noise_by": "client", "fraction_evaluate": 0.0, "clip_quantile": 0.5}, "clip-quantile=0.5"),
        ({**PRIVATE, "noise_by": "nobody"}, "noise-by='nobody'"),
        ({"secure_aggregation": True, "clip_norm": 1.0}, "normalisation='pooled'"),
        ({"secure_aggregation": True, "clip_norm": 1.0, "normalisation": "base", "fraction_evaluate": 0.0,
          "exchange": "int8"}, "exchange='int8'"),
        ({"secure_aggregation": True, "clip_norm": 1.0, "normalisation": "base", "fraction_evaluate": 0.0,
          "num_clients": 2}, "fraction-train=0.4"),
        ({"secure_aggregation": True, "clip_norm": 1.0, "normalisation": "base", "fraction_evaluate": 0.0,
          "strategy": "fedmedian"}, "strategy='fedmedian'"),
        ({"delta": 2.0}, "delta=2.0"),
        ({**PRIVATE, "delta": 1.0}, "delta=1.0"),
        ({**PRIVATE, "num_clients": 1}, "num-clients=1"),
        ({**PRIVATE, "epsilon_budget": 100.0}, "secret-noise=False"),
    ],
)  # fmt: skip
def test_settings_that_would_break_the_promise_are_refused_in_one_line(settings, word):
    with pytest.raises(ValueError, match="is not usable: give") as refused:
        check(Config(**settings))
    assert word in str(refused.value) and "\n" not in str(refused.value)


@pytest.fixture(scope="module")
def tiny(recording, tmp_path_factory):
    """Settings of the tiny profile with noise; nothing of the recording but the noised models is released."""
    out = tmp_path_factory.mktemp("outputs")
    settings = {**PRIVATE, "normalisation": "base", "clip_norm": 0.05, "fraction_evaluate": 0.0, **NO_ROLLOUTS}
    return from_profile("tiny", base="nano", data=str(recording), out=str(out), **settings)


def run(config):
    root = inline.run_inline(config, progress=False)
    assert run_folder.read_metrics(root, "rejected").empty
    return root


@pytest.mark.integration
@pytest.mark.parametrize(
    "settings",
    [
        *({"strategy": name} for name in STRATEGIES if name not in EACH),
        *({"strategy": name, "noise_by": "client", "num_malicious": 0} for name in EACH),
        {"local_optimizer": "adamw-shared", "exchange": "int8", "lora_rank": 2},
        {"strategy": "scaffold", "personal": "projections", "noise_by": "client"},
    ],
    ids=lambda settings: "-".join(map(str, settings.values())),
)
def test_noise_works_with_every_strategy(tiny, settings):
    config = replace(tiny, **settings)
    root = run(replace(config, num_server_rounds=1))
    events = run_folder.read_metrics(root, "privacy")
    assert len(events) == 1 and events.epsilon[0] == accountant.epsilon(config, 1, SIZE) > 0


@pytest.mark.integration
def test_a_run_with_noise_is_repeatable_weighs_alike_and_writes_what_it_spent(tiny):
    root, again = run(tiny), run(tiny)
    events = run_folder.read_metrics(root, "privacy")
    assert events.releases.tolist() == [1, 2] and (np.diff(events.epsilon) > 0).all()
    assert same(global_weights(root, 2), global_weights(again, 2))
    assert run_folder.read_metrics(root, "data").num_examples.tolist() == [1, 1, 1]
    secret = run(replace(tiny, secret_noise=True))
    assert not same(global_weights(root, 1), global_weights(secret, 1))


@pytest.mark.integration
def test_a_client_that_trusts_nobody_sends_no_loss_no_statistics_and_keeps_count_itself(tiny):
    root = run(replace(tiny, noise_by="client"))
    trained = run_folder.read_metrics(root, "train")
    assert "loss" not in trained and trained.steps.tolist() == [2] * 6
    over = replace(tiny, epsilon_budget=accountant.epsilon(tiny, 1, SIZE) * 1.01, secret_noise=True)
    with pytest.raises(ValueError, match="num-server-rounds=1"):
        inline.run_inline(over, progress=False)
    trusting_nobody, context = replace(over, noise_by="client"), Context(1, 1, {}, RecordDict(), {})
    client_app._spend(trusting_nobody, context, SIZE)
    with pytest.raises(ValueError, match="budget is spent"):
        client_app._spend(trusting_nobody, context, SIZE)


@pytest.mark.integration
@pytest.mark.parametrize("settings", [{"noise_by": "client"}, {"noise_by": "together", "secure_aggregation": True}])
def test_clients_really_add_the_noise(tiny, settings):
    """They hardly learn, so that what moves the model is the noise."""
    config = replace(tiny, lr=1e-12, num_server_rounds=1, **settings)
    before, after = (global_weights(run(config), number) for number in (0, 1))
    moved = np.concatenate([(after[n] - before[n]).ravel() for n in after if (after[n] != before[n]).any()])
    parts = 3 if config.noise_by == "client" else 3 / secure_aggregation.least_survivors(3)
    assert moved.std() == pytest.approx(config.noise * config.clip_norm * parts**0.5 / 3, rel=0.02)


@pytest.mark.integration
def test_a_client_that_hides_its_update_keeps_the_reason_of_a_failure_for_itself(tiny, caplog):
    with pytest.raises(TooFewReplies):
        inline.run_inline(replace(tiny, lr=1e9, noise_by="client", local_steps=8, min_replies=3), progress=False)
    root = max(Path(tiny.out).glob("*/metrics.jsonl"), key=lambda file: file.stat().st_mtime).parent
    details = run_folder.read_metrics(root, "rejected").detail
    assert len(details) and details.str.contains("in its own log").all() and "loss is" in caplog.text
