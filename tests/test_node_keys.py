"""A number belongs to whoever holds its key, whoever claims it first."""

from dataclasses import replace

import pytest
from flwr.app import Context, RecordDict
from flwr.common.constant import SUPERLINK_NODE_ID

from fedvla_lib import run_folder
from fedvla_lib.config import from_profile, to_run_config
from fedvla_lib.engines.credentials import make_node_key
from fedvla_lib.engines.inline import FIRST_NODE_ID, RUN_ID, InlineGrid, claim_identity
from fedvla_lib.federation import client, client_app, node_keys, server_app
from fedvla_lib.federation.messages import KEY, PARTITION
from fedvla_lib.policy.parameters import ParameterError

NODE = FIRST_NODE_ID


@pytest.fixture
def keys(tmp_path):
    return [make_node_key(tmp_path / "keys", f"node_{k}") for k in range(3)]


@pytest.mark.unit
def test_a_signature_holds_for_one_run_one_node_and_one_number(keys, tmp_path):
    check, signed = node_keys.proof(tmp_path / "keys", 7), node_keys.sign(keys[1].private, 7, NODE, 1)
    check(NODE, 1, signed)
    elsewhere = node_keys.proof(tmp_path / "keys", 8)
    for refuse, node, number, signature in (
        (check, NODE + 1, 1, signed), (check, NODE, 2, signed), (check, NODE, 1, None), (check, NODE, 1, "text"),
        (elsewhere, NODE, 1, signed), (check, NODE, 9, node_keys.sign(keys[1].private, 7, NODE, 9)),
    ):  # fmt: skip
        with pytest.raises(ParameterError, match=f"partition-id={number}") as refused:
            refuse(node, number, signature)
        assert refused.value.kind == "key"


@pytest.mark.unit
def test_what_is_no_key_is_named(tmp_path):
    (tmp_path / "node_0").write_text("no key")
    with pytest.raises(ValueError, match="node_0 is not a private key of `fedvla credentials`"):
        node_keys.sign(tmp_path / "node_0", 1, 2, 0)
    with pytest.raises(ValueError, match=r"has no node_K.pub: give the folder"):
        node_keys.proof(tmp_path, 1)


@pytest.mark.integration
def test_the_number_s_owner_takes_part_although_another_claims_it_first(recording, keys, tmp_path):
    config = from_profile(
        "tiny", data=str(recording), num_clients=3, num_server_rounds=1, local_steps=1, eval_rollouts=0,
        client_rollouts=0, node_keys=str(tmp_path / "keys"), out=str(tmp_path / "runs"),
    )  # fmt: skip
    claim_identity()
    loaders = client.cached(client.LOADERS)
    grid = InlineGrid(client_app.build(loaders), 3, to_run_config(config))
    for k, key in enumerate(keys):
        grid._contexts[NODE + k].node_config[KEY] = str(key.private)
    grid._contexts[NODE].node_config[PARTITION] = 1  # it introduces itself before the owner
    context = Context(RUN_ID, SUPERLINK_NODE_ID, {}, RecordDict(), to_run_config(config))
    server_app.build(loaders, engine="inline")(grid, context)
    (root,) = (tmp_path / "runs").iterdir()
    rejected = run_folder.read_metrics(root, "rejected")
    assert rejected[["who", "reason"]].to_numpy().tolist() == [[f"node_{NODE}", "key"]]
    assert sorted(run_folder.read_metrics(root, "train").who) == ["client_1", "client_2"]
    assert run_folder.read_config(root) == replace(config, node_keys="")  # no path to the keys is kept
