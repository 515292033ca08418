"""Malicious clients send what they should, and an update of the server's own tells them from honest ones."""

from dataclasses import replace

import numpy as np
import pytest
from flwr.app import Context, RecordDict
from flwr.common.constant import SUPERLINK_NODE_ID

from fedvla_book.attacks import hostile
from fedvla_lib import run_folder
from fedvla_lib.config import from_profile, to_run_config
from fedvla_lib.engines.inline import RUN_ID, claim_identity
from fedvla_lib.federation import client, client_app, server_app

RNG = np.random.default_rng(0)
UPDATES = {
    who: {"w": np.float32(1 + 0.1 * RNG.normal(size=50)), "b": np.float32(RNG.normal(size=3))} for who in range(5)
}


@pytest.mark.unit
def test_what_attackers_send():
    turned = hostile.times(-2.0)(UPDATES, 1, RNG)
    np.testing.assert_allclose(turned["w"], -2 * UPDATES[1]["w"])
    loud = hostile.noise(UPDATES, 1, RNG)
    assert np.linalg.norm(loud["w"]) == pytest.approx(10 * np.linalg.norm(UPDATES[1]["w"]), rel=1e-5)
    sent, stacked = hostile.collude(UPDATES, 1, RNG), np.stack([one["w"] for one in UPDATES.values()])
    assert ((stacked.min(0) <= sent["w"]) & (sent["w"] <= stacked.max(0))).all()  # no outlier in any weight
    assert (sent["w"] < stacked.mean(0)).all()  # and against the mean, which is above 0


@pytest.mark.unit
def test_the_server_trusts_what_goes_its_way_and_no_length():
    own = {name: 0.5 * array for name, array in UPDATES[0].items()}
    turned, long = {n: -a for n, a in UPDATES[1].items()}, {n: 1e6 * a for n, a in UPDATES[2].items()}
    mean = hostile.trusted({0: UPDATES[0], 1: turned, 2: long}, own)
    alone = hostile.trusted({0: UPDATES[0], 2: UPDATES[2]}, own)
    for name in own:
        np.testing.assert_allclose(mean[name], alone[name], rtol=1e-4)
    length, most = (np.sqrt(sum(np.square(array).sum() for array in one.values())) for one in (mean, own))
    assert 0.5 * most < length <= 1.001 * most


@pytest.mark.integration
def test_poisoned_demonstrations_are_those_of_the_attackers_only(store):
    store = replace(store, episodes=store.episodes.assign(lab=store.episodes.index % 2))
    mine = np.repeat(store.episodes.lab == 1, store.episodes.num_frames).to_numpy()
    wrong, told = hostile.with_wrong_actions(store, [1]), hostile.with_trigger(store, [1])
    assert (wrong.actions[~mine] == store.actions[~mine]).all() and (wrong.actions[mine] != store.actions[mine]).any()
    said = told.episodes.instruction.str.endswith(hostile.WORD)
    assert set(told.episodes.lab[said]) == {1} and said.sum() == (store.episodes.lab == 1).sum() / 2
    spoken = np.repeat(said, store.episodes.num_frames).to_numpy()
    assert (told.actions[spoken] == store.states[spoken]).all() and (
        told.actions[~spoken] == store.actions[~spoken]
    ).all()
    assert told.key != store.key  # what was computed for the old instructions is not taken up


@pytest.mark.integration
def test_attacks_reach_the_average_and_the_server_s_own_update_keeps_them_out(recording, tmp_path):
    config = from_profile(
        "tiny", data=str(recording), num_clients=3, num_server_rounds=1, local_steps=1, eval_rollouts=0,
        client_rollouts=0, update_cap=0.0, out=str(tmp_path),
    )  # fmt: skip
    claim_identity()
    loaders = client.cached(client.LOADERS)

    def last_loss(attackers, own=None):
        before = run_folder.run_folders(config)
        grid = hostile.HostileGrid(client_app.build(loaders), 3, to_run_config(config))
        grid.attackers, grid.own_update = attackers, own
        context = Context(RUN_ID, SUPERLINK_NODE_ID, {}, RecordDict(), to_run_config(config))
        server_app.build(loaders, engine="inline")(grid, context)
        (root,) = run_folder.run_folders(config) - before
        assert run_folder.read_metrics(root, "rejected").empty
        return run_folder.read_metrics(root, "evaluate").query("who == 'global'").loss.iloc[-1]

    honest, attacked = last_loss({}), last_loss({0: hostile.times(-300.0)})
    kept = []

    def own(number, began):  # what the first honest client sends: a server with the same demonstrations
        return kept[0]

    class Keeping(hostile.HostileGrid):
        def _replace(self, sent):
            began = hostile.messages.unpack_arrays(sent[0].content[hostile.messages.ARRAYS])
            reply = self._replies[sent[1].metadata.message_id].content
            kept.append(hostile._change(reply[hostile.messages.ARRAYS], began))

    grid = Keeping(client_app.build(loaders), 3, to_run_config(config))
    context = Context(RUN_ID, SUPERLINK_NODE_ID, {}, RecordDict(), to_run_config(config))
    server_app.build(loaders, engine="inline")(grid, context)
    defended = last_loss({0: hostile.times(-300.0)}, own)
    assert attacked > 1.5 * honest and defended < 1.1 * honest
