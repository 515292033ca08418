"""Secure aggregation: the sum is right, the server sees nothing else, and clients may drop out at any stage."""

from dataclasses import replace
from random import Random

import numpy as np
import pytest
from flwr.app import ConfigRecord, Context, Message, MetricRecord, RecordDict
from flwr.clientapp import ClientApp
from scipy.stats import chisquare

from fedvla_lib import run_folder
from fedvla_lib.config import Config, from_profile, to_run_config
from fedvla_lib.engines import inline
from fedvla_lib.engines.inline import FIRST_NODE_ID, InlineGrid, claim_identity
from fedvla_lib.federation import accountant, messages, privacy, secure_round
from fedvla_lib.federation import secure_aggregation as secure
from fedvla_lib.federation.nodes import Roster, TooFewReplies
from fedvla_lib.federation.secure_round import KEYS, SHARES, TRAIN, UNMASK, SecureGrid
from fedvla_lib.federation.strategies import build
from fedvla_lib.policy.parameters import digest
from test_federation import NO_ROLLOUTS, global_weights

pytestmark = pytest.mark.unit
SHAPES = {"w": (50, 4), "b": ()}
SECURE = {"secure_aggregation": True, "clip_norm": 2.0, "normalisation": "base", "fraction_evaluate": 0.0}


@pytest.fixture(autouse=True)
def identity():
    claim_identity()


def client_with(updates, config, fails=()):
    """A ClientApp that sends `updates[k]` under masks; `fails` are (type of message, client) that raise."""
    app = ClientApp()

    def failing(handler, kind):
        def handle(message, context):
            if (kind, context.node_config["partition-id"]) in fails:
                raise OSError("the line is down")
            return handler(message, context)

        return handle

    def train(message: Message, context: Context) -> Message:
        k = context.node_config["partition-id"]
        payload = privacy.from_client({messages.ARRAYS: updates[k]}, config, 1, k)
        arrays = secure_round.masked_update(payload, message, context, config)
        content = RecordDict({
            messages.ARRAYS: messages.pack_arrays(arrays), messages.NOTE: messages.make_note(sha256=digest(arrays)),
            messages.METRICS: MetricRecord({messages.EXAMPLES: 1, messages.STEPS: 1, "seconds": 0.0}),
        })  # fmt: skip
        return Message(content, reply_to=message)

    app.train()(failing(train, TRAIN))
    for name, handler in secure_round.HANDLERS.items():
        app.train(name)(failing(handler, f"train.{name}"))
    return app


class Overheard(InlineGrid):
    """Keeps everything that the server gets."""

    def push_messages(self, messages):
        ids = super().push_messages(messages)
        self.__dict__.setdefault("heard", []).extend(self._replies[key] for key in ids)
        return ids


def one_round(updates, fails=(), start=None, **settings):
    """Return the new global arrays minus the old ones, the events, and what the server heard."""
    config = Config(**{"num_clients": len(updates), "fraction_train": 1.0, **SECURE, **settings})
    inner, events = Overheard(client_with(updates, config, fails), len(updates), to_run_config(config)), []
    grid = SecureGrid(inner, config, SHAPES, ("arrays",), lambda *event: events.append(event))
    roster = Roster({node: node - FIRST_NODE_ID for node in grid.get_node_ids()})
    strategy = build.build_strategy(
        config, roster=roster, shapes=SHAPES, report=lambda *event: events.append(event), keep_rollouts=lambda *_: None
    )
    start = start or {name: np.zeros(shape, np.float32) for name, shape in SHAPES.items()}
    sent = strategy.configure_train(1, messages.pack_arrays(start), ConfigRecord(), grid)
    sent = sorted(sent, key=lambda message: message.metadata.dst_node_id)  # Flower draws them in an order of its own
    arrays, _ = strategy.aggregate_train(1, grid.send_and_receive(sent, timeout=60.0))
    arrays = messages.unpack_arrays(arrays)
    return {name: arrays[name] - start[name] for name in SHAPES}, events, inner.heard


def random_updates(count, scale=0.1):
    rng = np.random.default_rng(count)
    return [{n: np.float32(scale * rng.normal(size=s)) for n, s in SHAPES.items()} for _ in range(count)]


def off(found, updates):
    """Largest difference to the plain mean of the updates, all clipped."""
    short = [privacy.clipped({"arrays": one}, SECURE["clip_norm"])["arrays"] for one in updates]
    return max(np.abs(found[name] - np.mean([one[name] for one in short], axis=0)).max() for name in SHAPES)


@pytest.mark.parametrize("count", [3, 4, 10, 30])
def test_the_sum_is_the_plain_average_up_to_the_step_of_the_grid(count):
    updates = random_updates(count, scale=0.3)
    found, events, _ = one_round(updates)
    step = secure.grid_for(Config(num_clients=count, fraction_train=1.0, **SECURE)).step
    assert off(found, updates) <= step / 2 + 1e-7
    [told] = [values for _, _, kind, values in events if kind == "secure"]
    assert told["clients"] == told["summed"] == count and told["bytes"] > 1000 * count and told["seconds"] > 0
    assert not [kind for _, _, kind, _ in events if kind == "drift"]


def test_neighbours_are_mutual_few_and_enough():
    for count in (3, 4, 21, 22, 100):
        near = secure.neighbours(range(count))
        assert all(me in near[other] and other != me for me in near for other in near[me])
        assert {len(others) for others in near.values()} == {min(count - 1, secure.MOST_NEIGHBOURS)}


def test_a_masked_vector_is_uniform_and_never_the_same_twice():
    """Of one client, against all that the server gets besides; the update itself is far from uniform."""
    peers = {k: secure.new_secrets() for k in range(3)}
    public = {k: secure.public(secrets) for k, secrets in peers.items()}
    vector = np.full(200_000, 7)
    seen = []
    for _ in range(2):
        secrets = secure.new_secrets()
        masked = secure.masked(vector, secrets, 9, public)
        counts = [np.bincount((masked >> shift) & 255, minlength=256) for shift in (0, 8, 16, 24)]
        assert min(chisquare(count).pvalue for count in counts) > 1e-5
        assert abs(np.corrcoef(masked[1:].astype(float), masked[:-1].astype(float))[0, 1]) < 0.01
        seen.append(masked)
    assert (seen[0] != seen[1]).mean() > 0.999


def test_who_knows_the_own_mask_of_a_client_still_sees_nothing():
    """The seed can be put together when a client answered; the masks of its neighbours have to remain."""
    public = {k: secure.public(secure.new_secrets()) for k in range(3)}
    secrets, vector = secure.new_secrets(), np.full(200_000, 7)
    rest = secure.unmasked(secure.masked(vector, secrets, 9, public), [secrets.seed], {}, {}, {})
    assert chisquare(np.bincount(rest >> 24, minlength=256)).pvalue > 1e-5 and (rest == 7).mean() < 1e-3


def test_the_server_hears_no_update_in_any_message():
    updates = random_updates(4)
    _, _, heard = one_round(updates)
    replies = [reply.content for reply in heard if messages.ARRAYS in reply.content]
    assert len(replies) == 4 and len(heard) == 16
    grid = secure.grid_for(Config(num_clients=4, fraction_train=1.0, **SECURE))
    for content, update in zip(replies, updates, strict=True):
        vector = grid.real(messages.unpack_arrays(content[messages.ARRAYS])[secure_round.MASKED])
        sent = np.concatenate([update[name].ravel() for name in SHAPES])
        assert abs(np.corrcoef(vector, sent)[0, 1]) < 0.3 and "loss" not in content[messages.METRICS]


@pytest.mark.parametrize("kind", [KEYS, SHARES, TRAIN, UNMASK])
@pytest.mark.parametrize("lost", [(1,), (0, 4)])
def test_clients_that_drop_out_do_not_spoil_the_sum_of_the_others(kind, lost):
    updates = random_updates(6)
    found, events, _ = one_round(updates, fails=[(kind, k) for k in lost])
    summed = updates if kind == UNMASK else [one for k, one in enumerate(updates) if k not in lost]
    assert off(found, summed) < 1e-6
    [told] = [values for _, _, event, values in events if event == "secure"]
    assert told["lost"] == (0 if kind == UNMASK else len(lost))
    rejected = {who for _, who, event, _ in events if event == "rejected"}
    assert rejected == (set() if kind == UNMASK else {f"client_{k}" for k in lost})


@pytest.mark.parametrize(("count", "lost", "survives"), [(3, 1, False), (4, 1, True), (5, 1, True), (5, 2, False)])
def test_how_many_may_be_lost_is_known_before_anybody_unmasks(count, lost, survives):
    updates, fails = random_updates(count), [(TRAIN, k) for k in range(lost)]
    if survives:
        assert off(one_round(updates, fails=fails)[0], updates[lost:]) < 1e-6
    else:
        with pytest.raises(TooFewReplies, match="sent their masked update"):
            one_round(updates, fails=fails)


def test_a_round_with_fewer_clients_than_the_noise_is_made_for_ends():
    with pytest.raises(TooFewReplies, match="6 are needed"):
        one_round(random_updates(5), num_clients=10, noise=1.0, noise_by="together")
    with pytest.raises(ValueError, match="num-clients=4 allow for 4"):
        one_round(random_updates(6), num_clients=4)


@pytest.mark.parametrize("noise_by", ["client", "together"])
def test_noise_never_wraps_around(noise_by):
    """Many rounds of zeros: an overflow would be as large as the range of the grid."""
    zeros = [{name: np.zeros(shape, np.float32) for name, shape in SHAPES.items()}] * 3
    config = {"noise": 3.0, "noise_by": noise_by}
    found = [one_round(zeros, **config)[0]["w"].ravel() for _ in range(3)]
    parts = 3 if noise_by == "client" else 3 / secure.least_survivors(3)
    assert np.abs(found).max() < 6 * 3.0 * SECURE["clip_norm"] * parts**0.5 / 3
    assert np.std(found) == pytest.approx(3.0 * SECURE["clip_norm"] * parts**0.5 / 3, rel=0.15)


def test_the_order_of_arrays_at_a_client_does_not_matter():
    updates = random_updates(4)
    turned = [dict(reversed(update.items())) for update in updates]
    assert off(one_round(turned)[0], updates) < 1e-6


MALFORMED = {  # what a client says in place of the truth, by type of message
    "no keys": (KEYS, lambda record: record.clear()),
    "numbers for keys": (KEYS, lambda record: record.update({"masking": 7})),
    "junk for keys": (KEYS, lambda record: record.update({"masking": b"-----BEGIN"})),
    "no shares": (SHARES, lambda record: record.clear()),
    "shares for strangers": (SHARES, lambda record: record.update({"peers": [k + 7 for k in record["peers"]]})),
    "too few shares": (SHARES, lambda record: record.update({"contents": record["contents"][:1]})),
    "no shares back": (UNMASK, lambda record: record.clear()),
    "shares of strangers back": (UNMASK, lambda record: record.update({"peers": [k + 7 for k in record["peers"]]})),
    "text back": (UNMASK, lambda record: record.update({"contents": ["x"] * len(record["peers"])})),
}


@pytest.mark.parametrize("what", MALFORMED)
def test_a_client_that_sends_nonsense_is_left_out_and_ends_nothing(what, monkeypatch):
    kind, spoil = MALFORMED[what]
    honest = secure_round.HANDLERS[kind.removeprefix("train.")]

    def lying(message, context):
        reply = honest(message, context)
        if context.node_config["partition-id"] == 1:
            spoil(reply.content[secure_round.RECORD])
        return reply

    monkeypatch.setitem(secure_round.HANDLERS, kind.removeprefix("train."), lying)
    updates = random_updates(6)
    found, _, _ = one_round(updates)
    assert off(found, updates if kind == UNMASK else updates[:1] + updates[2:]) < 1e-6


def test_ciphertexts_that_nobody_can_open_cost_only_their_share(monkeypatch):
    def lying(message, context):
        reply = secure_round.send_shares(message, context)
        if context.node_config["partition-id"] == 1:
            record = reply.content[secure_round.RECORD]
            record["contents"] = [b"junk" * 20, *record["contents"][1:]]
        return reply

    monkeypatch.setitem(secure_round.HANDLERS, "shares", lying)
    updates = random_updates(6)
    assert off(one_round(updates)[0], updates) < 1e-6


def test_a_mean_longer_than_its_parts_may_be_ends_the_round(monkeypatch):
    """A client that does not clip: nobody can see which."""
    updates = random_updates(4)
    updates[0] = {name: 100 * array for name, array in updates[0].items()}
    monkeypatch.setattr(privacy, "clipped", lambda payload, limit: payload)
    with pytest.raises(TooFewReplies, match="a client lied"):
        one_round(updates)


def test_more_neighbours_than_one_has_to_lose_are_survived_on_a_sparse_graph(monkeypatch):
    monkeypatch.setattr(secure, "MOST_NEIGHBOURS", 6)
    monkeypatch.setattr(secure.neighbours, "__defaults__", (6,))
    # A ring on which no client has more than two of the four among its neighbours, which must answer four to six.
    monkeypatch.setattr(secure, "SystemRandom", lambda: Random(0))
    updates = random_updates(20)
    found, _, _ = one_round(updates, fails=[(TRAIN, 3), (TRAIN, 4), (KEYS, 11), (SHARES, 12)])
    assert off(found, [one for k, one in enumerate(updates) if k not in (3, 4, 11, 12)]) < 1e-6


@pytest.mark.parametrize(
    ("kind", "what"),
    [(KEYS, "sent keys"), (SHARES, "dealt shares"), (TRAIN, "sent their masked update"), (UNMASK, "came back")],
)
def test_too_many_drop_outs_end_the_round_with_a_clear_word(kind, what):
    with pytest.raises(TooFewReplies, match=what):
        one_round(random_updates(6), fails=[(kind, k) for k in range(4)])


@pytest.mark.parametrize(
    ("sent", "what"), [(np.ones(10), "expected 201 uint32"), (np.ones(400_000), "2 MB, expected at most 1")]
)
def test_a_malformed_vector_is_left_out_as_if_the_client_were_gone(sent, what):
    updates = random_updates(5)
    updates[2] = {"w": sent, "b": updates[2]["b"]}
    found, events, _ = one_round(updates)
    assert off(found, updates[:2] + updates[3:]) < 1e-6
    [detail] = [values["detail"] for _, _, kind, values in events if kind == "rejected"]
    assert what in detail


def prepared(count=4):
    """A client after it has sent its masked update, and the function that asks it for shares."""
    config = Config(num_clients=count, fraction_train=1.0, **SECURE)
    app = client_with(random_updates(count), config, [(UNMASK, k) for k in range(count)])
    grid = InlineGrid(app, count, to_run_config(config))
    layer = SecureGrid(grid, config, SHAPES, ("arrays",), lambda *_: None)
    content = {messages.ARRAYS: messages.pack_arrays({}), messages.CONFIG: ConfigRecord({messages.ROUND: 1})}
    orders = [Message(RecordDict(dict(content)), dst_node_id=n, message_type=TRAIN) for n in grid.get_node_ids()]
    with pytest.raises(TooFewReplies):
        layer.send_and_receive(orders)
    context = grid._contexts[FIRST_NODE_ID]

    def ask(summed, lost):
        record = ConfigRecord({"summed": summed, "lost": lost})
        order = Message(RecordDict({secure_round.RECORD: record}), dst_node_id=FIRST_NODE_ID, message_type=UNMASK)
        return secure_round.send_unmasking(order, context)

    return ask


def test_a_server_that_asks_for_both_shares_of_a_client_is_refused():
    with pytest.raises(ValueError, match="both shares of client 2"):
        prepared()([0, 1, 2, 3], [2])


def test_shares_are_given_once_and_only_for_a_sum_of_enough_clients():
    ask = prepared()
    with pytest.raises(ValueError, match="too few to hide among"):
        ask([0], [1, 2, 3])
    with pytest.raises(ValueError, match="too few to hide among"):
        ask([1, 2, 3], [])
    assert len(ask([0, 1, 3], [2]).content[secure_round.RECORD]["contents"]) == 3
    with pytest.raises((ValueError, KeyError)):
        ask([0, 1, 3], [2])


def test_shares_for_somebody_else_are_left_out():
    one, two = secure.new_secrets(), secure.new_secrets()
    public = {1: secure.public(one), 2: secure.public(two)}
    dealt = secure.deal(one, 1, {2: public[2], 3: secure.public(secure.new_secrets()), 4: public[2]})
    assert secure.opened(two.encryption, 2, 1, public[1], dealt[2])
    assert secure.opened(two.encryption, 2, 1, public[1], dealt[4]) is None
    assert secure.opened(two.encryption, 2, 1, public[1], dealt[3]) is None


@pytest.mark.parametrize("lost", [0, 2])
def test_noise_added_together_is_as_large_as_promised_or_larger(lost):
    """Of `least_survivors` clients; if more answer, there is more noise, never less."""
    size, count, noise = 20_000, 6, 1.5
    config = Config(num_clients=count, fraction_train=1.0, noise=noise, noise_by="together", **SECURE)
    grid, rng = secure.grid_for(config), np.random.default_rng(0)
    total = sum(secure.share_of_noise(config, size, rng) for _ in range(count - lost))
    assert np.abs(total).max() < secure.HALF
    wanted = noise * SECURE["clip_norm"] * ((count - lost) / secure.least_survivors(count)) ** 0.5
    assert wanted >= noise * SECURE["clip_norm"]
    assert (total * grid.step).std() == pytest.approx(wanted, rel=0.03)


@pytest.fixture(scope="module")
def tiny(recording, tmp_path_factory):
    """Settings of the tiny profile under secure aggregation."""
    out = tmp_path_factory.mktemp("outputs")
    return from_profile("tiny", base="nano", data=str(recording), out=str(out), **SECURE, **NO_ROLLOUTS)


@pytest.mark.integration
@pytest.mark.parametrize("settings", [{}, {"strategy": "scaffold"}, {"lora_rank": 2, "strategy": "fedadam"}])
def test_a_secure_run_learns_what_a_run_in_the_clear_learns(tiny, settings):
    """The run in the clear weighs alike, too: its noise is too small to matter."""
    config = replace(tiny, **settings)
    clear = replace(config, secure_aggregation=False, noise=1e-9)
    roots = [inline.run_inline(one, progress=False) for one in (config, clear)]
    left, right = (global_weights(root, 2) for root in roots)
    before = global_weights(roots[0], 0)
    apart, moved = (sum(np.square(right[n] - o[n]).sum() for n in right) ** 0.5 for o in (left, before))
    assert left.keys() == right.keys() and 0 < apart < 0.01 * moved  # rounding, made larger by adaptive optimisers
    told = run_folder.read_metrics(roots[0], "secure")
    assert told.summed.tolist() == [3, 3] and "loss" not in run_folder.read_metrics(roots[0], "train")


@pytest.mark.integration
def test_noise_by_all_together_protects_against_the_server_too(tiny):
    config = replace(tiny, noise=0.5, noise_by="together", clip_norm=0.05)
    root, again = (inline.run_inline(config, progress=False) for _ in range(2))
    left, right = (global_weights(one, 2) for one in (root, again))
    assert all(np.array_equal(left[name], right[name]) for name in left)  # the masks are secret, and cancel
    events = run_folder.read_metrics(root, "privacy")
    gauss = accountant.epsilon(replace(config, noise_by="server"), 2, 0)
    assert gauss < events.epsilon[1] < 1.3 * gauss  # of whole orders only, few of which fit so little noise


@pytest.mark.integration
@pytest.mark.slow
def test_secure_rounds_run_in_flowers_simulation(tiny):
    from fedvla_lib.engines.simulation import run_simulation

    root = run_simulation(tiny)
    inlined = inline.run_inline(tiny, progress=False)
    left, right = global_weights(root, 2), global_weights(inlined, 2)
    assert max(np.abs(left[name] - right[name]).max() for name in left) < 1e-6
    assert run_folder.read_metrics(root, "secure").summed.tolist() == [3, 3]
