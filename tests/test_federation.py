"""The federation end to end, on a real nano SmolVLA and recorded demonstrations, in the inline engine.

Faults are injected by real ClientApps around the library's own: they call it and then damage its reply.
"""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flwr.app import ConfigRecord, Context, Message, MetricRecord, RecordDict
from flwr.clientapp import ClientApp
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from safetensors.numpy import load_file

from fedvla_lib import run_folder
from fedvla_lib.config import EXCHANGES, STRATEGIES, from_profile, to_run_config
from fedvla_lib.data import lerobot_reader, normalisation, recordings, splits
from fedvla_lib.data.batches import Batches, frame_rows
from fedvla_lib.engines import inline
from fedvla_lib.evaluation import measure
from fedvla_lib.evaluation.video import read_video
from fedvla_lib.experiments import methods
from fedvla_lib.federation import client_app, messages
from fedvla_lib.federation.client import LOADERS, client_seed, open_client
from fedvla_lib.federation.nodes import TooFewReplies
from fedvla_lib.policy import model, prefix_cache, training
from fedvla_lib.policy.parameters import digest, layer_of, shapes_of, trainable_arrays
from fedvla_lib.robot.spec import ACTION_KEY, STATE_KEY

pytestmark = pytest.mark.integration
NO_ROLLOUTS = {"eval_rollouts": 0, "client_rollouts": 0}


@pytest.fixture(scope="module")
def tiny(recording, tmp_path_factory):
    """Settings of the tiny profile, from the nano base, on the recording that all tests share."""
    out = tmp_path_factory.mktemp("outputs")
    return from_profile("tiny", base="nano", data=str(recording), num_threads=1, out=str(out))


@pytest.fixture(scope="module")
def full_run(tiny):
    """A complete run: three clients, two rounds, rollouts and videos after the last."""
    return inline.run_inline(replace(tiny, tasks="lift,push"), progress=False)


def global_weights(root: Path, round_number: int) -> dict[str, np.ndarray]:
    return load_file(root / f"global_model/round_{round_number}/model.safetensors")


def same(left, right) -> bool:
    return left.keys() == right.keys() and all(np.array_equal(left[name], right[name]) for name in left)


@pytest.mark.parametrize("rank", [0, 4])
def test_one_client_averaging_equals_local_training_bit_for_bit(tiny, rank, tmp_path):
    config = replace(tiny, num_clients=1, num_server_rounds=2, local_steps=3, lora_rank=rank, **NO_ROLLOUTS)
    federated = global_weights(inline.run_inline(config, progress=False), 2)

    store = recordings.open_frames(config)
    train_ids, _ = splits.split(store, config.val_fraction, config.seed)
    bundle = model.load_policy(config, normalisation.pool_stats([normalisation.episode_stats(store, train_ids)]))
    batches = Batches(
        store, train_ids, config.chunk_size, config.batch_size, client_seed(config.seed, 0), config.augment
    )
    batches = prefix_cache.with_cached_prefixes(bundle, batches)  # as a client does
    for start in (training.Start(0, 6), training.Start(3, 6)):
        training.local_train(bundle, batches, config, steps=3, start=start, progress=False)
    model.save_policy(bundle, tmp_path / "local")  # with adapters added in
    assert same(federated, load_file(tmp_path / "local" / "model.safetensors"))


def test_of_one_client_a_full_batch_and_one_step_federated_and_centralized_are_alike(tiny):
    whole = open_client(replace(tiny, num_clients=1), 0).num_examples
    single = {"num_clients": 1, "num_server_rounds": 1, "local_steps": 1, "warmup_steps": 0}
    config = replace(tiny, **single, batch_size=whole, **NO_ROLLOUTS)
    start, federated, centralized = (
        bundle.shared_arrays()
        for bundle in (
            methods.base(config),
            methods.federated_policy(config),
            methods.centralized(config, progress=False),
        )
    )
    assert any(np.abs(federated[name] - start[name]).max() > 1e-5 for name in start)
    for name in start:
        np.testing.assert_allclose(federated[name], centralized[name], rtol=0, atol=1e-6)


def test_two_chapters_that_want_the_same_models_at_once_train_them_once(tiny):
    config = replace(tiny, seed=11, num_clients=1, num_server_rounds=1, local_steps=1, **NO_ROLLOUTS)
    with ThreadPoolExecutor(2) as chapters:
        first, second = chapters.map(methods.federated, [config, config])
        alone = list(chapters.map(methods.local_only, [config, config], [0, 0]))
    assert first == second and list(first.parent.glob("*/")) == [first]
    assert same(*(bundle.shared_arrays() for bundle in alone))


def test_a_model_in_the_cache_keeps_the_steps_that_it_counted_beside_weights_that_still_load(tiny, monkeypatch):
    config = replace(tiny, seed=12, num_clients=2, num_server_rounds=2, local_steps=3, **NO_ROLLOUTS)
    with pytest.raises(ValueError, match="centralized has not been trained with these settings"):
        methods.counted(config)
    trained = [methods.centralized(config, progress=False), methods.local_only(config, 1, progress=False)]
    assert methods.counted(config) == {"in_all": 12, "in_a_row": 12}
    assert methods.counted(config, 1) == {"in_all": 6, "in_a_row": 6}  # a share of the steps, not all of them
    folders = [methods._folder(config, client) for client in (None, 1)]
    for bundle, kept in zip(trained, folders, strict=True):
        assert (kept / methods.STEPS_FILE).is_file()
        monkeypatch.chdir(kept)  # where LeRobot looks for the backbone
        assert same(SmolVLAPolicy.from_pretrained(kept).state_dict(), bundle.policy.state_dict())


def test_a_model_that_stopped_early_is_not_said_to_have_taken_the_steps_of_the_settings(tiny, monkeypatch):
    config = replace(tiny, seed=13, num_clients=2, num_server_rounds=2, local_steps=3, **NO_ROLLOUTS)
    early = lambda *of, steps, **how: training.local_train(*of, steps=steps - 1, **how)  # noqa: E731
    monkeypatch.setattr(methods, "local_train", early)
    methods.centralized(config, progress=False)
    assert methods.counted(config) == {"in_all": 11, "in_a_row": 11} and methods.total_steps(config) == 12


def test_two_runs_with_one_seed_agree_bit_for_bit(tiny):
    config = replace(tiny, fraction_train=0.7, **NO_ROLLOUTS)
    first, second = (inline.run_inline(config, progress=False) for _ in range(2))
    assert first != second
    for round_number in range(3):
        assert same(global_weights(first, round_number), global_weights(second, round_number))
    drop = ["time", "seconds"]
    left, right = (run_folder.read_metrics(root).drop(columns=drop) for root in (first, second))
    assert left.equals(right)
    assert not same(global_weights(first, 1), global_weights(first, 2))


def test_a_run_folder_holds_what_the_book_needs(full_run):
    config = run_folder.read_config(full_run)
    stamp = run_folder.read_stamp(full_run)
    assert (stamp["status"], stamp["engine"], stamp["seed"]) == ("completed", "inline", config.seed)
    assert stamp["wall_s"] > 0 and stamp["versions"]["flwr"]
    metrics = run_folder.read_metrics(full_run, "evaluate")
    on_server = metrics[metrics.who == "global"].set_index("round")
    assert list(on_server.index) == [0, 1, 2]
    assert on_server[["loss", "action_error", "action_accuracy"]].notna().all(axis=None)
    assert on_server.success_rate.notna().tolist() == [False, False, True]
    assert set(run_folder.read_metrics(full_run, "train").who) == {"client_0", "client_1", "client_2"}
    for round_number in range(3):
        bundle = model.load_policy(replace(config, base=str(full_run / f"global_model/round_{round_number}")))
        assert shapes_of(trainable_arrays(bundle.policy))


def test_videos_come_back_from_every_client_and_play(full_run):
    rollouts = run_folder.read_metrics(full_run, "rollout")
    assert set(rollouts.who) == {"global", "client_0", "client_1", "client_2"}
    assert rollouts.groupby("who").size().to_dict()["global"] == 2  # one per task
    for who, video, steps in zip(rollouts.who, rollouts.video, rollouts.steps, strict=True):
        assert video.startswith(f"evaluate/round_2/{who}/rollout_")
        assert len(read_video(full_run / video)) == steps
    scenes = rollouts[rollouts.who != "global"]
    assert scenes.seed.is_unique


def test_a_reloaded_global_model_measures_the_same(full_run):
    config = run_folder.read_config(full_run)
    store = recordings.open_frames(config)
    bundle = model.load_policy(replace(config, base=str(full_run / "global_model/round_2")))
    found = measure.measure(bundle, store, config)
    frames, again = found.num_examples, found.averages
    logged = run_folder.read_metrics(full_run, "evaluate").query("who == 'global' and round == 2").iloc[0]
    assert frames == logged.num_examples
    assert again["loss"] == pytest.approx(logged.loss, rel=1e-6)
    assert again["action_error"] == pytest.approx(logged.action_error, rel=1e-5)


def test_clients_weigh_by_their_training_frames_and_normalise_with_pooled_statistics(full_run):
    config = run_folder.read_config(full_run)
    store = recordings.open_frames(config)
    shares = splits.shares(store, config)
    frames = {f"client_{k}": len(frame_rows(store, share.train_ids)) for k, share in enumerate(shares)}
    trained = run_folder.read_metrics(full_run, "train")
    assert all(frames[who] == weight for who, weight in zip(trained.who, trained.num_examples, strict=True))
    assert len(set(frames.values())) > 1

    folder = full_run / "global_model/round_2"
    saved = load_file(next(folder.glob("policy_preprocessor_step_*normalizer*.safetensors")))
    pooled = normalisation.episode_stats(store, [episode for share in shares for episode in share.train_ids])
    for key in (STATE_KEY, ACTION_KEY):
        np.testing.assert_allclose(saved[f"{key}.mean"], pooled[key]["mean"], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(saved[f"{key}.std"], pooled[key]["std"], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("scheme", ["modulo", "task", "dirichlet"])
def test_nothing_held_out_is_trained_on_and_nobody_shares(tiny, scheme):
    store = recordings.open_frames(tiny)
    shares = splits.shares(store, replace(tiny, partition=scheme))
    trained = [episode for share in shares for episode in share.train_ids]
    held_out = [episode for share in shares for episode in share.val_ids]
    assert sorted(trained + held_out) == sorted(store.episodes.episode_id)
    assert sorted(held_out) == sorted(splits.held_out_episodes(store, tiny))
    for share in shares:
        assert set(splits.tasks_of(store, share.val_ids)) <= set(splits.tasks_of(store, share.train_ids))


def damaging(damage_of, tools) -> ClientApp:
    """The library's ClientApp, with ``damage_of[partition_id]``, if any, applied to the training reply."""
    inner, outer = client_app.build(tools), ClientApp()

    @outer.query()
    def query(message: Message, context: Context) -> Message:
        return inner(message, context)

    @outer.train()
    def train(message: Message, context: Context) -> Message:
        content = inner(message, context).content
        damage = damage_of.get(context.node_config["partition-id"], lambda content: None)
        damage(content)
        return Message(content, reply_to=message)

    @outer.evaluate()
    def evaluate(message: Message, context: Context) -> Message:
        return inner(message, context)

    return outer


def change_arrays(change, *, honest: bool = True):
    """Return a damage that changes the arrays and, if `honest`, the announced hash with them."""

    def damage(content: RecordDict) -> None:
        arrays = change(messages.unpack_arrays(content[messages.ARRAYS]))
        content[messages.ARRAYS] = messages.pack_arrays(arrays)
        if honest:
            content[messages.NOTE][messages.DIGEST] = digest(arrays)

    return damage


def change_first(change):
    def of_all(arrays):
        name = next(iter(arrays))
        return {**arrays, name: change(arrays[name])}

    return of_all


def no_examples(content: RecordDict) -> None:
    content[messages.METRICS] = MetricRecord({**content[messages.METRICS], messages.EXAMPLES: 0})


PATIENCE_S = 15.0  # a busy machine needs seconds for the first client, who loads the policy


def sleep(content: RecordDict) -> None:
    time.sleep(PATIENCE_S + 0.5)


def crash(content: RecordDict) -> None:
    raise OSError("no space left on device")


DAMAGE = {
    "non-finite": change_arrays(change_first(lambda array: array * np.float32("nan"))),
    "shape": change_arrays(change_first(lambda array: array.T.copy())),
    "names": change_arrays(lambda arrays: {f"{name}_": array for name, array in arrays.items()}),
    "hash": change_arrays(change_first(lambda array: array + np.float32(1)), honest=False),
    "examples": no_examples,
    "silent": sleep,
    "error": crash,
}


def test_corrupted_replies_are_rejected_by_name_and_reason_and_the_round_goes_on(tiny):
    config = replace(tiny, num_clients=8, num_server_rounds=1, local_steps=1, round_timeout_s=PATIENCE_S, **NO_ROLLOUTS)
    tools = inline.cached(LOADERS)
    app = damaging(dict(enumerate(DAMAGE.values())), tools)
    root = inline.run_inline(config, clients_app=app, progress=False)

    rejected = run_folder.read_metrics(root, "rejected").query("round == 1")
    assert dict(zip(rejected.who, rejected.reason, strict=True)) == {f"client_{k}": r for k, r in enumerate(DAMAGE)}
    assert "no space left on device" in rejected.detail.iloc[-1]
    counts = run_folder.read_metrics(root, "replies").query("to == 'train'").iloc[0]
    assert (counts.good, counts.rejected, counts.rejected_hash) == (1, 7, 1)
    assert run_folder.counted_steps(root) == {"in_all": 1, "in_a_row": 1}  # averaged steps, not requested ones

    store = tools.open_frames(config)
    alone = open_client(config, 7, tools)
    pooled = normalisation.pool_stats(
        [normalisation.episode_stats(store, share.train_ids) for share in splits.shares(store, config)]
    )
    bundle = model.load_policy(config, pooled)
    alone.train(bundle, 1)
    only_good = trainable_arrays(bundle.policy)
    assert same({name: global_weights(root, 1)[name] for name in only_good}, only_good)


def test_too_few_good_replies_stop_the_run_and_leave_what_there_is(tiny, tmp_path):
    config = replace(tiny, min_replies=2, out=str(tmp_path), **NO_ROLLOUTS)
    app = damaging({0: crash, 2: DAMAGE["hash"]}, inline.cached(LOADERS))
    with pytest.raises(TooFewReplies, match="round 1: 1 of 3 training replies are valid, min-replies=2 are required"):
        inline.run_inline(config, clients_app=app, progress=False)
    (root,) = tmp_path.iterdir()
    assert run_folder.read_stamp(root)["status"].startswith("failed: TooFewReplies")
    assert global_weights(root, 0)
    assert dict(run_folder.read_metrics(root, "rejected")[["who", "reason"]].values) == {
        "client_0": "error",
        "client_2": "hash",
    }


def test_a_client_that_cannot_introduce_itself_is_left_out(tiny):
    config = replace(tiny, num_server_rounds=1, local_steps=1, **NO_ROLLOUTS)
    inner, outer = client_app.build(inline.cached(LOADERS)), ClientApp()

    @outer.query()
    def query(message, context):
        if context.node_config["partition-id"] == 1:
            raise lerobot_reader.DataError("episode 3 has a truncated video")
        return inner(message, context)

    outer.train()(lambda message, context: inner(message, context))
    outer.evaluate()(lambda message, context: inner(message, context))
    root = inline.run_inline(config, clients_app=outer, progress=False)
    assert set(run_folder.read_metrics(root, "train").who) == {"client_0", "client_2"}
    rejected = run_folder.read_metrics(root, "rejected").iloc[0]
    assert (rejected.to, rejected.reason) == ("query", "error")
    assert "truncated video" in rejected.detail


def test_a_client_refuses_global_arrays_that_were_altered_on_the_way(tiny):
    config = replace(tiny, **NO_ROLLOUTS)
    client = open_client(config, 0)
    arrays = trainable_arrays(model.load_policy(config, client.statistics()).policy)
    announced = digest(arrays)
    arrays[next(iter(arrays))] += 1
    instructions = {
        messages.ROUND: 1,
        messages.DIGEST: announced,
        messages.STATS: normalisation.pack_stats(client.statistics()),
    }
    inline.claim_identity()
    grid = inline.InlineGrid(client_app.build(), 1, to_run_config(replace(config, num_clients=1)))
    content = RecordDict({messages.ARRAYS: messages.pack_arrays(arrays), messages.CONFIG: ConfigRecord(instructions)})
    (reply,) = grid.send_and_receive([Message(content, inline.FIRST_NODE_ID, "train")])
    assert reply.has_error()
    assert "SHA-256" in reply.error.reason


def test_an_exception_surfaces_when_asked_for(tiny):
    config = replace(tiny, num_server_rounds=1, **NO_ROLLOUTS)
    app = damaging({1: crash}, inline.cached(LOADERS))
    with pytest.raises(OSError, match="no space left"):
        inline.run_inline(config, clients_app=app, progress=False, raise_errors=True)


@pytest.mark.unit
def test_a_partition_that_does_not_exist_is_refused_with_the_remedy(tiny):
    with pytest.raises(ValueError, match="partition-id=3 is not one of num-clients=3 partitions"):
        open_client(tiny, 3)


@pytest.mark.unit
def test_rollouts_are_due_every_so_many_rounds_and_at_the_end():
    config = from_profile("tiny", num_server_rounds=5)
    due = {n: [r for r in range(6) if measure.rolls_out(replace(config, eval_every=n), r)] for n in (0, 2)}
    assert due == {0: [5], 2: [0, 2, 4, 5]}


@pytest.mark.unit
def test_client_streams_differ():
    seeds = {client_seed(seed, k) for seed in range(5) for k in range(10)}
    assert len(seeds) == 50


def last_weights(config):
    return global_weights(inline.run_inline(config, progress=False, raise_errors=True), config.num_server_rounds)


def test_every_strategy_trains_the_robot_policy_and_fedprox_without_weight_is_fedavg(tiny):
    config = replace(tiny, num_clients=2, num_malicious=0, fraction_evaluate=0.0, **NO_ROLLOUTS)
    weights = {name: last_weights(replace(config, strategy=name, proximal_mu=0.0)) for name in STRATEGIES}
    assert same(weights["fedprox"], weights["fedavg"])
    different = [name for name in STRATEGIES if name != "fedprox"]
    for i, left in enumerate(different):
        for right in different[:i]:
            if {left, right} != {"fedavg", "fedmedian"}:  # of two clients the median is the mean
                assert not same(weights[left], weights[right]), (left, right)


def test_the_proximal_term_changes_what_clients_learn(tiny):
    config = replace(tiny, num_clients=2, strategy="fedprox", **NO_ROLLOUTS)
    assert not same(last_weights(config), last_weights(replace(config, proximal_mu=0.0)))


def test_a_kept_optimiser_goes_on_in_the_next_round(tiny):
    settings = [replace(tiny, keep_optimizer=keep, **NO_ROLLOUTS) for keep in (True, False)]
    kept, reset = (inline.run_inline(config, progress=False) for config in settings)
    assert same(global_weights(kept, 1), global_weights(reset, 1))  # nothing to keep yet
    assert not same(global_weights(kept, 2), global_weights(reset, 2))


def test_a_run_records_the_bytes_exchanged_and_the_client_drift(tiny):
    config = replace(tiny, num_clients=2, num_server_rounds=1, **NO_ROLLOUTS)
    sizes = {}
    for name in ("fedavg", "scaffold"):
        root = inline.run_inline(replace(config, strategy=name), progress=False)
        replies = run_folder.read_metrics(root, "replies").set_index("to")
        sizes[name] = replies.loc["train", ["sent_bytes", "received_bytes"]].astype(int)
        arrays = trainable_arrays(model.load_policy(replace(config, base=str(root / "global_model/round_1"))).policy)
        payload = 2 * sum(array.nbytes for array in arrays.values())  # of both clients
        copies = {"fedavg": 1, "scaffold": 2}[name]
        assert (sizes[name] > copies * payload).all() and (sizes[name] < 1.05 * copies * payload).all()
    drift = run_folder.read_metrics(root, "drift")
    assert list(drift.who) == ["client_0", "client_1"] and (drift["norm.all"] > 0).all()
    assert drift["toward.client_1"][0] == pytest.approx(drift["toward.client_0"][1])


def test_global_models_are_saved_and_measured_as_often_as_set(tiny):
    config = replace(tiny, num_clients=2, num_server_rounds=5, validate_every=3, **NO_ROLLOUTS)
    root = inline.run_inline(config, progress=False)
    events = run_folder.read_metrics(root, "evaluate")
    assert events[events.who == "global"]["round"].tolist() == [0, 3, 5]
    assert {path.name for path in (root / "global_model").iterdir()} == {"round_0", "round_3", "round_5"}


def test_rounded_exchange_learns_the_same_for_fewer_bytes(tiny):
    config = replace(tiny, num_clients=2, local_steps=4, **NO_ROLLOUTS)
    losses, sizes = {}, {}
    for exchange in EXCHANGES:
        root = inline.run_inline(replace(config, exchange=exchange), progress=False, raise_errors=True)
        replies = run_folder.read_metrics(root, "replies").query("to == 'train'")
        sizes[exchange] = replies[["sent_bytes", "received_bytes"]].sum()
        events = run_folder.read_metrics(root, "evaluate").query("who == 'global'")
        losses[exchange] = events.loss.to_numpy()
        assert run_folder.read_metrics(root, "rejected").empty
    learned = losses["float32"][0] - losses["float32"][-1]
    assert learned > 0
    for exchange, down, up in (("float16", 0.5, 0.5), ("int8", 0.5, 0.25)):
        assert abs(losses[exchange][-1] - losses["float32"][-1]) < 0.02 * learned
        share = sizes[exchange] / sizes["float32"]
        assert share.sent_bytes == pytest.approx(down, abs=0.03)
        assert share.received_bytes == pytest.approx(up, abs=0.03)


def test_personal_parts_stay_with_their_client(tiny):
    config = replace(tiny, num_clients=2, personal="projections", **NO_ROLLOUTS)
    seen = []

    def watched(message, context):
        reply = honest(message, context)
        seen.append((message.metadata.message_type, context.node_config["partition-id"], message, reply, context))
        return reply

    honest = client_app.build(inline.cached(LOADERS))
    app = ClientApp()
    for kind in (app.query, app.train, app.evaluate):
        kind()(watched)
    root = inline.run_inline(config, clients_app=app, progress=False, raise_errors=True)
    start, end = (global_weights(root, number) for number in (0, 2))
    moved = {name for name in start if not np.array_equal(start[name], end[name])}
    assert moved and {layer_of(name) for name in moved} == {f"expert layer {i}" for i in range(4)}
    trained = [one for one in seen if one[0] == "train"]
    for _, _, message, reply, _ in trained:
        for arrays in (message.content[messages.ARRAYS], reply.content[messages.ARRAYS]):
            assert "projections" not in {layer_of(name) for name in arrays}
    own = [messages.unpack_arrays(context.state[client_app.PERSONAL]) for _, _, _, _, context in trained[-2:]]
    assert {layer_of(name) for name in own[0]} == {"projections"}
    assert all(not np.array_equal(own[0][name], own[1][name]) for name in own[0])
    assert all(not np.array_equal(own[0][name], start[name]) for name in own[0])


def test_personal_parts_that_make_no_sense_are_refused(tiny):
    everything = ",".join(["projections", *(f"expert layer {i}" for i in range(4))])
    for parts, message in (("head", "'head'.*projections"), (everything, "nothing to share")):
        with pytest.raises(ValueError, match=message):
            model.load_policy(replace(tiny, personal=parts))
