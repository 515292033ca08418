"""Aggregation and checks of replies, with Flower's messages and apps on small arrays, without a robot policy."""

import hashlib
import io
import json
import pickle

import numpy as np
import pytest
from flwr.app import Array, ArrayRecord, ConfigRecord, Context, Message, MetricRecord, RecordDict
from flwr.clientapp import ClientApp

from fedvla_lib.config import Config
from fedvla_lib.data import normalisation
from fedvla_lib.engines.inline import FIRST_NODE_ID, InlineGrid, claim_identity
from fedvla_lib.evaluation.video import encode_video
from fedvla_lib.federation.messages import (
    ARRAYS,
    CONFIG,
    EXAMPLES,
    METRICS,
    NOTE,
    STEPS,
    checked_arrays,
    make_note,
    pack_arrays,
    round_of,
    unpack_arrays,
)
from fedvla_lib.federation.nodes import Roster, TooFewReplies, introduce_nodes, plain, wait_for_nodes
from fedvla_lib.federation.rollout_replies import unpack_rollouts
from fedvla_lib.federation.strategies import build
from fedvla_lib.policy.parameters import ParameterError, digest, shapes_of

pytestmark = pytest.mark.unit
SHAPES = {"weight": (5, 3), "bias": (3,), "gain": ()}


@pytest.fixture(autouse=True)
def identity():
    claim_identity()


def random_arrays(seed, scale=1.0):
    rng = np.random.default_rng(seed)
    return {name: np.asarray(scale * rng.normal(size=shape), np.float32) for name, shape in SHAPES.items()}


def reply_content(arrays, examples=10, loss=1.0, steps=2):
    return {
        ARRAYS: pack_arrays(arrays),
        METRICS: MetricRecord({EXAMPLES: examples, STEPS: steps, "loss": loss, "seconds": 0.1}),
        NOTE: make_note(sha256=digest(arrays)),
    }


def answering(content_of) -> ClientApp:
    """A ClientApp whose training reply is what `content_of(partition_id, global arrays)` returns."""
    app = ClientApp()

    @app.train()
    def train(message: Message, context: Context) -> Message:
        arrays = unpack_arrays(message.content[ARRAYS])
        content = content_of(context.node_config["partition-id"], arrays)
        if NOTE in content:
            content[NOTE] = ConfigRecord({**round_of(message.content), **content[NOTE]})
        return Message(RecordDict(content), reply_to=message)

    return app


class Events(list):
    """Collects the events that a run folder would write."""

    def log(self, round_number, who, kind, values):
        self.append((round_number, who, kind, values))

    def rejected(self):
        return {who: values["reason"] for _, who, kind, values in self if kind == "rejected"}


def one_round(
    app, num_clients, *, start=None, server_round=1, reverse=False, announced=None, shapes=SHAPES, **settings
):
    """Return the aggregated arrays, the metrics and the events of one training round; by default all clients train."""
    events = Events()
    grid = InlineGrid(app, num_clients, {})
    nodes = grid.get_node_ids()
    announced = [announced] * num_clients if isinstance(announced, int) else announced
    config = Config(**{"fraction_train": 1.0, **settings})
    examples_of = dict(zip(nodes, announced or [], strict=bool(announced)))
    roster = Roster({node: node - FIRST_NODE_ID for node in nodes}, examples_of, frames_cap=config.frames_cap)
    strategy = build.build_strategy(
        config, roster=roster, shapes=shapes, report=events.log,
        keep_rollouts=lambda *_: None,
    )  # fmt: skip
    start = start or random_arrays(99)
    messages = strategy.configure_train(server_round, pack_arrays(start), ConfigRecord(), grid)
    replies = grid.send_and_receive(messages)
    replies = replies[::-1] if reverse else replies
    arrays, metrics = strategy.aggregate_train(server_round, replies)
    return unpack_arrays(arrays), metrics, events


def test_aggregation_equals_a_float64_reference():
    examples = [7, 120, 33, 1, 64, 5, 900, 18, 2, 51]
    updates = [random_arrays(k, scale=3.0) for k in range(10)]
    app = answering(lambda k, _: reply_content(updates[k], examples[k]))
    averaged, _, _ = one_round(app, 10)
    for name in SHAPES:
        stacked = np.stack([update[name].astype(np.float64) for update in updates])
        expected = np.average(stacked, axis=0, weights=examples)
        np.testing.assert_allclose(averaged[name], expected, atol=1e-6, rtol=1e-6)
        assert averaged[name].dtype == np.float32
        assert averaged[name].shape == SHAPES[name]


@pytest.mark.parametrize("num_clients", [1, 2, 3, 10])
def test_equal_clients_average_to_themselves(num_clients):
    same = random_arrays(5)
    averaged, _, _ = one_round(answering(lambda k, _: reply_content(same, 10 + k)), num_clients)
    for name in SHAPES:
        np.testing.assert_allclose(averaged[name], same[name], rtol=1e-6)


def test_one_client_is_not_changed_at_all():
    update = random_arrays(5)
    averaged, _, _ = one_round(answering(lambda k, _: reply_content(update, 123)), 1)
    assert digest(averaged) == digest(update)


def test_the_result_does_not_depend_on_who_answers_first():
    app = answering(lambda k, _: reply_content(random_arrays(k), 3 + 7 * k))
    forward, forward_metrics, _ = one_round(app, 10)
    backward, backward_metrics, _ = one_round(app, 10, reverse=True)
    assert digest(forward) == digest(backward)
    assert dict(forward_metrics) == dict(backward_metrics)


def test_it_does_not_matter_which_client_is_called_what():
    def called(names):
        return answering(lambda k, _: reply_content(random_arrays(names[k]), 3 + 7 * names[k]))

    (straight, _, _), (shuffled, _, _) = (one_round(called(names), 5) for names in (range(5), [3, 1, 4, 0, 2]))
    for name in SHAPES:
        np.testing.assert_allclose(straight[name], shuffled[name], rtol=1e-6, atol=1e-7)


def test_twice_the_examples_count_as_being_there_twice():
    once, _, _ = one_round(answering(lambda k, _: reply_content(random_arrays(k), examples=[10, 20][k])), 2)
    twice, _, _ = one_round(answering(lambda k, _: reply_content(random_arrays([0, 1, 1][k]), examples=10)), 3)
    for name in SHAPES:
        np.testing.assert_allclose(once[name], twice[name], rtol=1e-6, atol=1e-7)


def test_metrics_are_averaged_by_examples():
    app = answering(lambda k, _: reply_content(random_arrays(k), [30, 10][k], loss=[1.0, 5.0][k]))
    _, metrics, events = one_round(app, 2)
    assert metrics["loss"] == pytest.approx((30 * 1.0 + 10 * 5.0) / 40)
    assert [(who, values["num_examples"]) for _, who, kind, values in events if kind == "train"] == [
        ("client_0", 30),
        ("client_1", 10),
    ]


def _without(content, key):
    return {name: record for name, record in content.items() if name != key}


def _nan(arrays):
    return {**arrays, "bias": np.full(3, np.nan, np.float32)}


def _raise():
    raise RuntimeError("disk on fire")


GOOD = random_arrays(1)


def _with_bias(content, dtype="float32", shape=(3,)):
    """A reply that is valid except for the bytes of one array."""
    record = ArrayRecord({**pack_arrays(GOOD), "bias": Array(dtype, shape, "numpy.ndarray", content)})
    return {**reply_content(GOOD), ARRAYS: record}


def _npz():
    buffer = io.BytesIO()
    np.savez(buffer, bias=GOOD["bias"])
    return buffer.getvalue()


def _npy(header, rest=b"\0" * 12):
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + rest


def _claiming(shape, descr="<f4"):
    return _npy(f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}}}\n")


class Trap:
    """Creates a file when unpickled."""

    def __reduce__(self):
        return open, ("unpickled", "w")


def _pickled():
    buffer = io.BytesIO()
    np.save(buffer, np.array([Trap()], dtype=object), allow_pickle=True)
    return buffer.getvalue()


HUGE = (10**12,)


FAULTS = {
    "nan": ("non-finite", lambda: reply_content(_nan(GOOD))),
    "wrong shape": ("shape", lambda: reply_content({**GOOD, "bias": np.zeros(4, np.float32)})),
    "renamed array": ("names", lambda: reply_content({("W" if n == "weight" else n): a for n, a in GOOD.items()})),
    "missing array": ("names", lambda: reply_content(_without(GOOD, "gain"))),
    "an array too many": ("names", lambda: reply_content({**GOOD, "more": np.zeros(3, np.float32)})),
    "wrong dtype": ("dtype", lambda: reply_content({n: a.astype(np.float64) for n, a in GOOD.items()})),
    "undecodable bytes": ("dtype", lambda: _with_bias(b"not an array")),
    "a pickle": ("dtype", lambda: _with_bias(_pickled(), "object", (1,))),
    "a bare pickle": ("dtype", lambda: _with_bias(pickle.dumps(Trap()))),
    "an archive": ("dtype", lambda: _with_bias(_npz())),
    "half an archive": ("dtype", lambda: _with_bias(b"PK\x03\x04 and no more")),
    "no bytes": ("dtype", lambda: _with_bias(b"")),
    "half a header": ("dtype", lambda: _with_bias(_claiming((3,))[:30])),
    "a header that is no Python": ("dtype", lambda: _with_bias(_npy("{'descr': '<f4', 'shape': (3,)\0"))),
    "a header too deep for Python": ("dtype", lambda: _with_bias(_npy("-" * 9000 + "1"))),
    "more numbers than memory": ("shape", lambda: _with_bias(_claiming(HUGE))),
    "declared so as well": ("shape", lambda: _with_bias(_claiming(HUGE), shape=HUGE)),
    "more numbers than 64 bits": ("shape", lambda: _with_bias(_claiming((0, 10**30)))),
    "numbers of no bytes": ("dtype", lambda: _with_bias(_claiming(HUGE, "<U0"), "<U0", HUGE)),
    "another type than declared": ("dtype", lambda: _with_bias(_claiming((3,), "<i4"))),
    "bytes too many": ("shape", lambda: _with_bias(_claiming((3,)) + b"more")),
    "wrong hash": ("hash", lambda: {**reply_content(GOOD), NOTE: make_note(sha256=hashlib.sha256().hexdigest())}),
    "no hash": ("hash", lambda: _without(reply_content(GOOD), NOTE)),
    "no arrays": ("names", lambda: _without(reply_content(GOOD), ARRAYS)),
    "no metrics": ("metrics", lambda: _without(reply_content(GOOD), METRICS)),
    "zero examples": ("examples", lambda: reply_content(GOOD, examples=0)),
    "negative examples": ("examples", lambda: reply_content(GOOD, examples=-5)),
    "no step": ("metrics", lambda: reply_content(GOOD, steps=0)),
    "half a step": ("metrics", lambda: reply_content(GOOD, steps=2.5)),
    "steps that were not counted": ("metrics", lambda: reply_content(GOOD, steps=float("nan"))),
    "infinite loss": ("metrics", lambda: reply_content(GOOD, loss=float("inf"))),
    "extra metric": (
        "metrics",
        lambda: {**reply_content(GOOD), METRICS: MetricRecord({EXAMPLES: 1, "loss": 1.0, "vote": 9.0})},
    ),
    "exception": ("error", _raise),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_bad_reply_is_rejected_by_name_and_reason_and_the_round_goes_on(fault, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    reason, bad = FAULTS[fault]
    app = answering(lambda k, _: bad() if k == 1 else reply_content(random_arrays(k)))
    averaged, _, events = one_round(app, 3, min_replies=2)
    assert events.rejected() == {"client_1": reason}
    counted = next(values for _, _, kind, values in events if kind == "replies")
    assert (counted["good"], counted["rejected"], counted[f"rejected_{reason}"]) == (2, 1, 1)
    for name in SHAPES:
        expected = (random_arrays(0)[name] + random_arrays(2)[name]) / 2
        np.testing.assert_allclose(averaged[name], expected, rtol=1e-6, atol=1e-7)
    assert not list(tmp_path.iterdir())  # no received code was executed


def flat(arrays):
    return np.concatenate([arrays[name].ravel() for name in SHAPES])


@pytest.mark.parametrize("factor", [-20.0, -1.0, 50.0], ids=["scaled and turned", "turned", "scaled"])
def test_one_poisoned_client_of_ten_breaks_an_average_without_limits_and_not_the_robust_strategies(factor):
    """Honest clients send similar updates; the tenth sends its update times a factor, with a valid hash."""
    start, wanted = random_arrays(99), random_arrays(98)

    def moved(k, _):
        noise = random_arrays(k, scale=0.2)
        times = factor if k == 0 else 1.0
        return reply_content({name: start[name] + np.float32(times) * (wanted[name] + noise[name]) for name in SHAPES})

    servers = {
        "fedavg": {"update_cap": 0.0}, "capped": {}, "fedmedian": {"strategy": "fedmedian"},
        "krum": {"strategy": "krum"}, "clipped": {"clip_norm": float(np.linalg.norm(flat(wanted)))},
    }  # fmt: skip
    off = {}
    for name, settings in servers.items():
        arrays, _, _ = one_round(answering(moved), 10, start=start, **settings)
        off[name] = np.linalg.norm(flat(arrays) - flat(start) - flat(wanted)) / np.linalg.norm(flat(wanted))
    assert off["fedmedian"] < 0.2 and off["krum"] < 0.5 and off["clipped"] < 0.35 and off["capped"] < 0.45
    assert off["fedavg"] > (2 * off["fedmedian"] if factor == -1.0 else 1.5)


def test_a_client_cannot_buy_weight_with_more_examples_than_it_came_with():
    app = answering(lambda k, _: reply_content(random_arrays(k), examples=10**9 if k == 1 else 10))
    averaged, _, events = one_round(app, 3, announced=10)
    assert events.rejected() == {"client_1": "examples"}
    expected = (random_arrays(0)["weight"] + random_arrays(2)["weight"]) / 2
    np.testing.assert_allclose(averaged["weight"], expected, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("cap", [0.0, 10.0], ids=["no limit", "ten times the median"])
def test_a_client_that_announces_more_frames_than_anyone_has_counts_for_a_limited_number(cap):
    frames = [8, 10, 12, 2**40]
    app = answering(lambda k, _: reply_content(random_arrays(k), frames[k]))
    averaged, _, _ = one_round(app, 4, announced=frames, frames_cap=cap)
    weights = [8, 10, 12, 110 if cap else 2**40]  # the median is 11
    wanted = np.average([random_arrays(k)["weight"] for k in range(4)], axis=0, weights=weights)
    np.testing.assert_allclose(averaged["weight"], wanted, rtol=1e-5, atol=1e-6)


def test_the_cap_on_frames_does_not_bind_clients_that_differ_as_labs_do():
    roster = Roster({k: k for k in range(4)}, {0: 20, 1: 100, 2: 140, 3: 900}, frames_cap=Config().frames_cap)
    assert [roster.weight(k) for k in range(4)] == [20, 100, 140, 900]


@pytest.mark.parametrize("cap", [0.0, 3.0], ids=["no limit", "three times the median"])
def test_an_update_much_longer_than_the_others_is_shortened_and_reported(cap):
    start = random_arrays(99)
    changes = [random_arrays(k, scale=1e6 if k == 2 else 1.0) for k in range(5)]
    app = answering(lambda k, _: reply_content({name: start[name] + changes[k][name] for name in SHAPES}))
    averaged, _, events = one_round(app, 5, start=start, update_cap=cap)
    lengths = [np.sqrt(sum(np.square(array).sum() for array in change.values())) for change in changes]
    factor = np.ones(5)
    if cap:
        factor[2] = cap * np.median(lengths) / lengths[2]
    for name in SHAPES:
        wanted = start[name] + np.mean([rate * change[name] for rate, change in zip(factor, changes, strict=True)], 0)
        np.testing.assert_allclose(averaged[name], wanted, rtol=1e-4, atol=1e-4)
    assert [who for _, who, kind, _ in events if kind == "capped"] == (["client_2"] if cap else [])


def test_where_most_clients_do_not_move_the_cap_takes_nothing_from_those_that_do():
    app = answering(
        lambda k, start: reply_content({n: start[n] + (random_arrays(k)[n] if k < 2 else 0) for n in SHAPES})
    )
    one, other = (one_round(app, 5, update_cap=cap)[0] for cap in (0.0, 3.0))
    assert all((one[name] == other[name]).all() for name in SHAPES)


@pytest.mark.parametrize("wrapped", build.ADD_NOISE)
def test_strategies_that_add_noise_of_their_own_get_updates_whose_lengths_are_the_client_s_own(wrapped):
    assert not build._checked(wrapped).caps_updates and build._checked(build.FedAvg).caps_updates


def test_the_cap_on_updates_changes_no_bit_where_lengths_differ_as_labs_do():
    app = answering(lambda k, start: reply_content({n: start[n] + random_arrays(k, 1.2**k)[n] for n in SHAPES}))
    one, other = (one_round(app, 4, update_cap=cap)[0] for cap in (0.0, Config().update_cap))
    assert all((one[name] == other[name]).all() for name in SHAPES)


def test_under_noise_no_length_depends_on_the_other_clients():
    """Else one client more or less would move the others' updates, beyond what the noise covers."""
    app = answering(lambda k, start: reply_content({n: start[n] + random_arrays(k, 50.0**k)[n] for n in SHAPES}))
    settings = {"clip_norm": 1e6, "noise": 1e-9, "normalisation": "base"}
    one, other = (one_round(app, 4, update_cap=cap, **settings)[0] for cap in (0.0, 1.0))
    assert all((one[name] == other[name]).all() for name in SHAPES)


def test_frames_are_taken_on_trust_and_only_some_strategies_do_without_them():
    """A client that announces a billion frames from the start and sends an update in the opposite direction."""
    start, wanted = random_arrays(99), random_arrays(98)

    def moved(k, _):
        noise = random_arrays(k, scale=0.2)
        factor, examples = (-5.0, 10**9) if k == 0 else (1.0, 10)
        arrays = {name: start[name] + np.float32(factor) * (wanted[name] + noise[name]) for name in SHAPES}
        return reply_content(arrays, examples)

    length, limit = float(np.linalg.norm(flat(wanted))), 0.5

    def mean_update(**settings):
        arrays, _, events = one_round(answering(moved), 10, start=start, update_cap=0.0, **settings)
        assert not events.rejected()
        return (flat(arrays) - flat(start)) / length, flat(wanted) / length

    for strategy in ("fedmedian", "krum"):
        update, honest = mean_update(strategy=strategy)
        assert np.linalg.norm(update - honest) < 0.5
    update, honest = mean_update(clip_norm=limit * length)
    assert update @ honest < 0 and np.linalg.norm(update) < 1.001 * limit  # in its direction, but no further
    update, honest = mean_update()
    assert update @ honest < -4


def test_clipping_shortens_an_update_and_keeps_its_direction():
    start, far = random_arrays(99), random_arrays(99)
    far = {name: array + 50 for name, array in far.items()}
    app = answering(lambda k, _: reply_content(far))
    averaged, _, _ = one_round(app, 2, start=start, clip_norm=2.0)
    moved = np.concatenate([(averaged[name] - start[name]).ravel() for name in SHAPES])
    assert np.linalg.norm(moved) == pytest.approx(2.0, rel=1e-5)
    np.testing.assert_allclose(moved, moved[0], rtol=1e-4)
    near, _, _ = one_round(app, 2, start=start, clip_norm=1e6)
    np.testing.assert_allclose(near[next(iter(SHAPES))], far[next(iter(SHAPES))], rtol=1e-5)


def test_the_reason_of_an_exception_reaches_the_events():
    app = answering(lambda k, _: _raise() if k == 0 else reply_content(random_arrays(k)))
    _, _, events = one_round(app, 2)
    detail = next(values["detail"] for _, _, kind, values in events if kind == "rejected")
    assert "disk on fire" in detail and "\n" not in detail


def test_a_client_that_does_not_reply_is_reported():
    events = Events()
    grid = InlineGrid(answering(lambda k, _: reply_content(random_arrays(k))), 2, {})
    roster = Roster({node: node - FIRST_NODE_ID for node in grid.get_node_ids()})
    checked = dict(roster=roster, shapes=SHAPES, report=events.log, keep_rollouts=lambda *_: None)
    strategy = build.build_strategy(Config(fraction_train=1.0), **checked)
    messages = strategy.configure_train(1, pack_arrays(GOOD), ConfigRecord(), grid)
    strategy.aggregate_train(1, grid.send_and_receive(messages)[:1])
    assert events.rejected() == {"client_1": "silent"}


@pytest.mark.parametrize(
    ("settings", "what"),
    [({"strategy": "fedadam"}, "v_t of 'weight'"), ({"strategy": "fedavgm", "server_lr": 1e9}, "arrays of 'weight'")],
    ids=["in the state", "in the model"],
)
def test_an_average_that_overflows_ends_the_run_although_each_reply_is_finite(settings, what):
    """With an infinite second moment FedAdam would never move the model again, and report completed rounds."""
    huge = {name: np.full(shape, 1e30, np.float32) for name, shape in SHAPES.items()}
    with pytest.raises(FloatingPointError, match=f"round 4: the average overflowed .{what} is not finite"):
        one_round(answering(lambda k, _: reply_content(huge)), 2, server_round=4, **settings)


def test_the_content_of_an_earlier_round_is_refused_by_name():
    stored = {}

    def again(k, _):
        return {**reply_content(random_arrays(k)), **(stored if k == 0 else {})}

    assert not one_round(answering(again), 3, server_round=1)[2].rejected()
    stored[NOTE] = make_note(sha256=digest(random_arrays(0)), server_round=1)
    _, _, events = one_round(answering(again), 3, server_round=2)
    assert events.rejected() == {"client_0": "round"} and "is of round 1, expected 2" in events[0][3]["detail"]


def test_a_reply_larger_than_it_can_need_is_refused_before_anything_is_unpacked():
    def huge(k, _):
        content = reply_content(GOOD)
        if k == 0:
            content[NOTE]["film"] = bytes(3_000_000)
        return content

    _, _, events = one_round(answering(huge), 2, reply_limit_mb=2.0)
    assert events.rejected() == {"client_0": "size"} and "3 MB, expected at most 2" in events[0][3]["detail"]
    assert not one_round(answering(huge), 2)[2].rejected()


def test_too_few_valid_replies_stop_the_run_with_a_clear_message():
    app = answering(lambda k, _: reply_content(_nan(GOOD)) if k else reply_content(GOOD))
    with pytest.raises(TooFewReplies, match="round 4: 1 of 3 training replies are valid, min-replies=2"):
        one_round(app, 3, min_replies=2, server_round=4)


def test_clients_are_sampled_from_the_seed_by_partition_not_by_node():
    rng = np.random.default_rng
    mirrored = Roster({1000 - k: k for k in range(20)})
    shifted = Roster({k + 77: k for k in range(20)})
    draws = []
    for roster in (mirrored, shifted):
        names_by_round = [[roster.name(node) for node in roster.sample(0.3, rng([0, r, 0]))] for r in range(8)]
        draws.append(names_by_round)
        assert all(len(set(names)) == 6 for names in names_by_round)
    assert draws[0] == draws[1]
    assert len({tuple(names) for names in draws[0]}) > 1
    assert mirrored.sample(0.0, rng(0)) == []
    assert len(mirrored.sample(0.001, rng(0))) == 1


def test_a_share_of_the_clients_trains():
    trained = []
    app = answering(lambda k, _: trained.append(k) or reply_content(random_arrays(k)))
    one_round(app, 10, fraction_train=0.4, seed=3)
    first = list(trained)
    one_round(app, 10, fraction_train=0.4, seed=3)
    assert len(first) == 4
    assert trained == first * 2


def test_what_a_client_does_to_a_message_stays_with_the_client():
    seen = []

    def vandal(k, arrays):
        seen.append(digest(arrays))
        for array in arrays.values():
            array += 1
        return reply_content(arrays)

    one_round(answering(vandal), 3)
    assert len(set(seen)) == 1


def test_messages_carry_the_hash_that_clients_check():
    checked = []

    app = ClientApp()

    @app.train()
    def train(message, context):
        arrays = checked_arrays(message.content, CONFIG, shapes_of(GOOD))
        checked.append(digest(arrays))
        content = reply_content(arrays)
        content[NOTE].update(round_of(message.content))
        return Message(RecordDict(content), reply_to=message)

    _, _, events = one_round(app, 2, start=GOOD)
    assert events.rejected() == {}
    assert checked == [digest(GOOD)] * 2


def statistics(count, **changed):
    """Statistics of a client with `count` frames; `changed` replaces measures of the action."""
    good = {"mean": np.zeros(6), "std": np.ones(6), "min": -np.ones(6), "max": np.ones(6), "count": np.array([count])}
    return {"observation.state": good, "action": {**good, **changed}}


def introducing(
    partition_of, stats_of=lambda k, frames: normalisation.pack_stats(statistics(frames)), **said
) -> ClientApp:
    """A ClientApp whose introduction is valid, except for `said` of the node with partition 1."""
    app = ClientApp()

    @app.query()
    def query(message, context):
        k = context.node_config["partition-id"]
        values = {"partition_id": partition_of[k], "num_examples": 5 + k, "tasks": ["lift"]}
        values["stats"] = stats_of(k, 5 + k)
        return Message(RecordDict({NOTE: make_note(**values | (said if k == 1 else {}))}), reply_to=message)

    return app


def _without_measure(name):
    return json.dumps(
        {key: _without(of, name) for key, of in json.loads(normalisation.pack_stats(statistics(6))).items()}
    )


def _action(**changed):
    """Statistics with changed measures of the action, also with values that NumPy would not write."""
    stats = json.loads(normalisation.pack_stats(statistics(6)))
    return json.dumps({**stats, "action": stats["action"] | changed})


INTRODUCTIONS = {
    "ragged": ("statistics", {"stats": _action(mean=[[0.0], [0.0, 1.0]])}),
    "not UTF-8": ("statistics", {"stats": b"\xff\xfe{}"}),
    "no JSON": ("statistics", {"stats": "{'mean': 0}"}),
    "too deep": ("statistics", {"stats": "[" * 100_000}),
    "too deep in a measure": ("statistics", {"stats": _action(mean=0.0).replace("0.0", "[" * 900 + "]" * 900, 1)}),
    "a list": ("statistics", {"stats": "[]"}),
    "a number": ("statistics", {"stats": 3.0}),
    "nothing": ("statistics", {"stats": ""}),
    "no count": ("statistics", {"stats": _without_measure("count")}),
    "no min": ("statistics", {"stats": _without_measure("min")}),
    "no action": ("statistics", {"stats": json.dumps(_without(json.loads(_action()), "action"))}),
    "five joints": ("statistics", {"stats": _action(mean=[0.0] * 5)}),
    "two counts": ("statistics", {"stats": _action(count=[6, 6])}),
    "a bare count": ("statistics", {"stats": _action(count=6)}),
    "negative std": ("statistics", {"stats": _action(std=[-1.0] * 6)}),
    "NaN": ("statistics", {"stats": _action(mean=[float("nan")] * 6)}),
    "infinite": ("statistics", {"stats": _action(max=[float("inf")] * 6)}),
    "its square is infinite": ("statistics", {"stats": _action(std=[1e300] * 6)}),
    "words": ("statistics", {"stats": _action(mean=["a lot"] * 6)}),
    "a mean out of range": ("statistics", {"stats": _action(mean=[7.0] * 6)}),
    "min above max": ("statistics", {"stats": _action(min=[2.0] * 6)}),
    "beyond what the arm can do": ("statistics", {"stats": _action(max=[1e5] * 6, std=[5e4] * 6)}),
    "a spread beyond its range": ("statistics", {"stats": _action(std=[1.1] * 6)}),
    "negative count": ("examples", {"stats": _action(count=[-6])}),
    "half a frame": ("statistics", {"stats": _action(count=[6.5])}),
    "a count beyond 64 bits": ("statistics", {"stats": _action(count=[10**30])}),
    "another count than num-examples": ("examples", {"stats": _action(count=[7])}),
    "another num-examples than its count": ("examples", {"num_examples": 10**9}),
    "extra measure": ("statistics", {"stats": _action(median=[0.0] * 6)}),
    "extra feature": ("statistics", {"stats": json.dumps({**json.loads(_action()), "gaze": {}})}),
    "more frames than anyone has": ("examples", {"num_examples": 2**62}),
    "frames that are true": ("examples", {"num_examples": True}),
    "negative partition": ("partition", {"partition_id": -1}),
    "a partition that there is not": ("partition", {"partition_id": 3}),
    "a partition that is true": ("partition", {"partition_id": True}),
    "one task as text": ("tasks", {"tasks": "lift"}),
    "tasks that are numbers": ("tasks", {"tasks": [1, 2]}),
    "more than a note can need": ("size", {"stats": "x" * 2_000_000}),
    "a task as long as a book": ("tasks", {"tasks": ["lift" * 1000]}),
}


@pytest.mark.parametrize("fault", INTRODUCTIONS)
def test_a_bad_introduction_is_refused_by_name_and_reason_and_the_rest_is_pooled(fault):
    reason, said = INTRODUCTIONS[fault]
    events = Events()
    grid = InlineGrid(introducing([0, 1, 2], **said), 3, {})
    roster = introduce_nodes(grid, wait_for_nodes(grid, 3, 1.0), events.log, 1.0, num_clients=3)
    kept = [FIRST_NODE_ID, FIRST_NODE_ID + 2]
    assert roster.nodes == kept and roster.partition_of == dict(zip(kept, [0, 2], strict=True))
    assert sorted(roster.stats_of) == sorted(roster.examples_of) == kept
    assert events.rejected() == {f"node_{FIRST_NODE_ID + 1}": reason}
    detail = events[0][3]["detail"]
    assert "\n" not in detail and (reason in ("partition", "size") or detail.startswith("client_1: "))
    pooled = normalisation.pool_stats([roster.stats_of[node] for node in roster.nodes])
    assert pooled["action"]["count"].tolist() == [5 + 7]
    np.testing.assert_array_equal(pooled["action"]["std"], np.ones(6))


def test_statistics_unlike_those_of_all_others_are_left_out_of_the_pool_by_name():
    """What stays is pooled exactly; a liar's count is capped too, so that it does not own the pool."""
    wide = {"min": -300.0 * np.ones(6), "max": 300.0 * np.ones(6)}
    events, frames = Events(), [10, 20, 30, 40]
    stats = [statistics(n, mean=np.full(6, k / 10)) for k, n in enumerate(frames)]
    honest = Roster({k: k for k in range(4)}, dict(enumerate(frames)), dict(enumerate(stats)))
    pooled = normalisation.pool_stats(honest.plausible_stats(events.log))
    assert not events
    np.testing.assert_array_equal(pooled["action"]["mean"], normalisation.pool_stats(stats)["action"]["mean"])
    for lie in ({"std": np.full(6, 200.0), **wide}, {"mean": np.full(6, 290.0), **wide}):
        roster = Roster(honest.partition_of, honest.examples_of, honest.stats_of | {2: statistics(30, **lie)})
        kept = normalisation.pool_stats(roster.plausible_stats(events.log))
        assert events.rejected() == {"client_2": "statistics"}
        assert kept["action"]["count"] == 70 and kept["action"]["std"].max() < 1.1
    capped = Roster(honest.partition_of, honest.examples_of | {1: 2**40}, honest.stats_of, frames_cap=2.0)
    assert normalisation.pool_stats(capped.plausible_stats(events.log))["action"]["count"] == 10 + 70 + 30 + 40


def test_what_a_client_says_is_logged_as_one_short_line_without_control_characters():
    said = plain("no\x1b[2J\n space \u202e" + "x" * 10**6)
    assert said.isprintable() and said.startswith("no [2J space x") and len(said) == 1000


@pytest.mark.parametrize("value", [0.1, -7e-30, 300.0])
def test_joints_that_never_move_can_be_pooled(value):
    """Through rounding, the mean of equal numbers can lie outside their range."""

    def stats_of(k, frames):
        measured = normalisation._describe(np.full((frames, 6), value, np.float32))
        return normalisation.pack_stats({"observation.state": measured, "action": measured})

    events = Events()
    grid = InlineGrid(introducing(range(60), stats_of), 60, {})
    assert len(introduce_nodes(grid, wait_for_nodes(grid, 60, 1.0), events.log, 1.0).nodes) == 60 and not events


@pytest.mark.parametrize("reverse", [False, True])
def test_of_two_nodes_with_one_number_the_first_keeps_it_whatever_its_id(reverse, monkeypatch):
    events, grid = Events(), InlineGrid(introducing([0, 1, 1]), 3, {})
    replies = grid.send_and_receive
    monkeypatch.setattr(grid, "send_and_receive", lambda *a, **k: replies(*a, **k)[:: -1 if reverse else 1])
    roster = introduce_nodes(grid, wait_for_nodes(grid, 3, 1.0), events.log, 1.0)
    second, third = FIRST_NODE_ID + 1, FIRST_NODE_ID + 2
    kept, refused = (third, second) if reverse else (second, third)
    assert roster.partition_of[kept] == 1 and events.rejected() == {f"node_{refused}": "partition"}
    assert f"is held by node {kept}, the first" in events[0][3]["detail"]


def test_introductions_are_ordered_by_partition_and_a_duplicate_is_rejected():
    events = Events()
    grid = InlineGrid(introducing([2, 0, 2, 1]), 4, {})
    roster = introduce_nodes(grid, wait_for_nodes(grid, 4, 1.0), events.log, 1.0)
    assert [roster.partition_of[node] for node in roster.nodes] == [0, 1, 2]
    assert list(events.rejected().values()) == ["partition"]


def test_missing_clients_are_named_with_the_remedy():
    grid = InlineGrid(introducing([0, 1]), 2, {})
    with pytest.raises(TooFewReplies, match="2 of num-clients=3 clients connected.*num-supernodes=3"):
        wait_for_nodes(grid, 3, 0.1)


STEPS_TAKEN = 3


def rolled_out(steps=STEPS_TAKEN, file="rollout_1", film=None, arrays=None, **said):
    """The note of a client with one rollout; `said` replaces what its row says."""
    row = {
        "task": "lift", "instruction": "Lift the cube.", "lab": "lab_0", "seed": 7, "success": False, "steps": steps,
        "completion_time_s": float("nan"), "action_smoothness": 0.5, "video": f"{file}.mp4",
    }  # fmt: skip
    trajectory = io.BytesIO()
    joints = np.zeros((STEPS_TAKEN, 6), np.float32)
    np.savez(trajectory, **(arrays or {"states": joints, "actions": joints, "success": False, "seed": 7}))
    film = encode_video(np.zeros((STEPS_TAKEN, 16, 32, 3), np.uint8)) if film is None else film
    names, files = [f"{file}.mp4", f"{file}.npz"], [film, trajectory.getvalue()]
    return {"rollouts": json.dumps([row | said]), "file_names": names, "files": files}


def unpacked(note, most=1, tasks=("lift", "push")):
    return unpack_rollouts(RecordDict({NOTE: make_note(**note)}), tasks, most)


def test_rollouts_arrive_as_they_were_sent():
    rows, files = unpacked(rolled_out())
    assert rows[0]["task"] == "lift" and np.isnan(rows[0]["completion_time_s"]) and len(files) == 2
    assert unpacked({"rollouts": "[]", "file_names": [], "files": []}, most=0) == ([], {})


def damaged():
    """A compressed trajectory with one byte of its content changed."""
    archive = io.BytesIO()
    joints = np.arange(6.0 * STEPS_TAKEN).reshape(-1, 6)
    np.savez_compressed(archive, states=joints, actions=joints, success=False, seed=7)
    content = bytearray(archive.getvalue())
    content[60:90] = bytes(30)
    return bytes(content)


BOMB = {"states": np.zeros(10_000_000), "actions": np.zeros((STEPS_TAKEN, 6)), "success": False, "seed": 7}
ROLLOUTS = {
    "an event of another": lambda: rolled_out(who="global"), "a round": lambda: rolled_out(round=3),
    "success in words": lambda: rolled_out(success="yes"), "a seed beyond 64 bits": lambda: rolled_out(seed=10**300),
    "no steps": lambda: rolled_out(steps=0), "more steps than the film": lambda: rolled_out(steps=4),
    "infinite": lambda: rolled_out(action_smoothness=float("inf")),
    "another task": lambda: rolled_out(task="juggle"), "a book": lambda: rolled_out(instruction="lift" * 999),
    "no film": lambda: rolled_out(film=b"x" * 1000), "an empty film": lambda: rolled_out(film=b""),
    "huge": lambda: rolled_out(film=bytes(20_000_001)),
    "text for bytes": lambda: rolled_out() | {"files": ["text", "text"]},
    "a trajectory that unpacks": lambda: rolled_out(arrays=BOMB),
    "code": lambda: rolled_out(arrays=BOMB | {"states": np.array([{}], dtype=object)}),
    "a trajectory of one number": lambda: rolled_out(arrays=BOMB | {"states": 0.0, "actions": 3.0}),
    "a damaged trajectory": lambda: rolled_out() | {"files": [rolled_out()["files"][0], damaged()]},
    "the root": lambda: rolled_out(file="/tmp/rollout_1"), "a folder": lambda: rolled_out(file="rollout_a/b"),
    "a program": lambda: rolled_out(video="rollout_1.py"),
    "another alphabet": lambda: rolled_out(file="rollout_\u00e9"),
    "a number for names": lambda: rolled_out() | {"file_names": 3}, "nested": lambda: rolled_out(rows=[[]]),
    "elsewhere": lambda: rolled_out(file="../evil"), "a long name": lambda: rolled_out(file=f"rollout_{'x' * 300}"),
    "another's file": lambda: rolled_out(video="rollout_2.mp4"),
    "too deep": lambda: rolled_out() | {"rollouts": "[" * 100_000},
    "numbers": lambda: rolled_out() | {"rollouts": "[3]"},
    "numbered files": lambda: rolled_out() | {"file_names": [3, 4]},
    "one file": lambda: rolled_out() | {"files": [b"x"]},
    "files only": lambda: rolled_out() | {"rollouts": "[]"},
}  # fmt: skip


@pytest.mark.parametrize("fault", ROLLOUTS)
def test_rollouts_that_no_client_was_asked_for_are_refused_in_a_line(fault):
    with pytest.raises(ParameterError, match="rollout|film") as caught:
        unpacked(ROLLOUTS[fault]())
    assert caught.value.kind == "rollouts"


def test_more_rollouts_than_asked_for_are_refused():
    with pytest.raises(ParameterError, match="1 rollouts, expected at most 0"):
        unpacked(rolled_out(), most=0)
