"""Flower's own strategies, privacy wrappers and mods around the library's two apps, and strategies from elsewhere."""

import io
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flwr.app import ConfigRecord
from flwr.cli.build import build_fab_from_disk
from flwr.clientapp import mod
from flwr.serverapp import strategy as flower
from safetensors.numpy import load_file

from fedvla_lib import run_folder
from fedvla_lib.cli.main import main
from fedvla_lib.config import from_profile, to_run_config
from fedvla_lib.engines import app_bundle, inline
from fedvla_lib.federation import client_app, messages
from fedvla_lib.federation.client import LOADERS
from fedvla_lib.federation.nodes import TooFewReplies
from fedvla_lib.policy import model

pytestmark = pytest.mark.integration
# What a reader would write, in a module of their own.
BROUGHT = """
from flwr.serverapp import strategy as flower


class Trimmed(flower.FedTrimmedAvg):
    def __init__(self):
        super().__init__(beta=0.34)


class Chosen(flower.MultiKrum):
    def __init__(self):
        super().__init__(num_malicious_nodes=0, num_nodes_to_select=2)


class Adam(flower.FedAdam):
    def __init__(self):
        super().__init__(eta=0.01)


class Private(flower.DifferentialPrivacyServerSideFixedClipping):
    def __init__(self):
        super().__init__(flower.FedAvg(), noise_multiplier=0.0, clipping_norm=1e-3, num_sampled_clients=3)


class Noisy(flower.DifferentialPrivacyServerSideAdaptiveClipping):
    def __init__(self):
        super().__init__(Adam(), noise_multiplier=0.01, num_sampled_clients=3, clipped_count_stddev=1.0)


class ClipsThemselves(flower.DifferentialPrivacyClientSideFixedClipping):
    def __init__(self):
        super().__init__(flower.FedAvg(), noise_multiplier=0.0, clipping_norm=1e-3, num_sampled_clients=3)


class AdaptThemselves(flower.DifferentialPrivacyClientSideAdaptiveClipping):
    def __init__(self):
        super().__init__(flower.FedMedian(), noise_multiplier=0.0, num_sampled_clients=3, initial_clipping_norm=1e-3)


class Silent(flower.FedAvg):
    def aggregate_train(self, server_round, replies):
        return None, None


class Greedy(flower.FedAvg):
    def __init__(self, beta):
        super().__init__()


NOTHING = 3
"""
CLIP = 1e-3


@pytest.fixture(scope="module")
def tools():
    """Frames and policy, opened once for all runs."""
    return inline.cached(LOADERS)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A working directory with the reader's module, which Python imports once."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "my_strategies.py").write_text(BROUGHT)
    return folder


@pytest.fixture
def tiny(recording, place, tmp_path, monkeypatch):
    """One round on all clients from the nano base, in that working directory."""
    monkeypatch.chdir(place)
    return from_profile(
        "tiny", base="nano", data=str(recording), num_server_rounds=1, local_steps=1, eval_rollouts=0,
        client_rollouts=0, fraction_evaluate=0.0, out=str(tmp_path / "outputs"),
    )  # fmt: skip


def run(config, tools, **mods):
    """Return the run folder of a run in which no reply was rejected."""
    app = client_app.build(tools, mods)
    root = inline.run_inline(config, clients_app=app, progress=False, raise_errors=True)
    assert run_folder.read_metrics(root, "rejected").empty
    return root


def moved(root):
    """The L2 norm of the global model's movement in round 1."""
    before, after = (load_file(root / f"global_model/round_{k}/model.safetensors") for k in (0, 1))
    return np.sqrt(sum(np.square(after[name] - before[name]).sum() for name in after))


STOCK = ("flwr.serverapp.strategy:FedMedian", "flwr.serverapp.strategy:Bulyan", *(
    f"my_strategies:{name}" for name in ("Adam", "Trimmed", "Chosen", "Noisy")))  # fmt: skip


@pytest.mark.parametrize("strategy", STOCK)
def test_a_strategy_of_flower_runs_by_its_name(strategy, tiny, tools):
    root = run(replace(tiny, strategy=strategy), tools)
    assert len(run_folder.read_metrics(root, "train")) == 3 and moved(root) > CLIP


def test_what_is_brought_is_the_strategy_of_the_same_name(tiny, tools):
    """With Flower's noise the seed fixes the run, too."""
    names = ("fedmedian", STOCK[0], "my_strategies:Noisy", "my_strategies:Noisy")
    roots = [run(replace(tiny, strategy=name, val_fraction=0.0), tools) for name in names]
    weights = [(root / "global_model/round_1/model.safetensors").read_bytes() for root in roots]
    assert weights[0] == weights[1] != weights[2] == weights[3]


@pytest.mark.parametrize("exchange", ["float32", "int8"])
def test_a_wrapper_clips_what_passed_the_checks(exchange, tiny, tools):
    """It clips before it averages, and our checks compare the SHA-256 of what the clients sent."""
    root = run(replace(tiny, strategy="my_strategies:Private", exchange=exchange), tools)
    assert 0 < moved(root) <= CLIP * 1.01


CLIENT_SIDE = {"ClipsThemselves": mod.fixedclipping_mod, "AdaptThemselves": mod.adaptiveclipping_mod}


@pytest.mark.parametrize("name", CLIENT_SIDE)
def test_clients_clip_with_flowers_mod_and_sign_what_they_send(name, tiny, tools):
    root = run(replace(tiny, strategy=f"my_strategies:{name}"), tools, train=[CLIENT_SIDE[name]])
    assert 0 < moved(root) <= CLIP * 1.01


def test_a_mod_acts_before_what_leaves_the_client_is_rounded_and_hidden(tiny, tools):
    noisy = mod.LocalDpMod(clipping_norm=CLIP, sensitivity=1e-9, epsilon=1.0, delta=0.1)
    assert moved(run(replace(tiny, exchange="int8"), tools, train=[noisy])) <= CLIP * 1.01
    secure = {"secure_aggregation": True, "clip_norm": 1.0, "normalisation": "base"}
    assert moved(run(replace(tiny, **secure), tools, train=[noisy])) <= CLIP * 1.01


def test_a_mod_of_one_handler_is_called_for_that_alone_and_others_are_refused(tiny, tools):
    seen = []

    def watch(message, context, call_next):
        seen.append(message.metadata.message_type)
        return call_next(message, context)

    run(tiny, tools, query=[watch])
    assert seen == ["query"] * 3
    for wrong in ([watch], {"training": [watch]}):
        with pytest.raises(ValueError, match=r"by handler \(query, train, evaluate\)"):
            client_app.build(tools, wrong)


def test_a_mod_that_cannot_work_says_so_in_flowers_words(tiny, tools):
    config = replace(tiny, strategy="scaffold")
    app = client_app.build(tools, {"train": [mod.fixedclipping_mod]})
    with pytest.raises(TooFewReplies):
        inline.run_inline(config, clients_app=app, progress=False)
    (root,) = run_folder.run_folders(config)
    assert "exactly one ArrayRecord" in run_folder.read_metrics(root, "rejected").detail[0]


def stock(strategy, config, tools):
    """Run a round of Flower's strategy in its own ServerApp's way, with our clients; return start, end and metrics."""
    inline.claim_identity()
    grid = inline.InlineGrid(client_app.build(tools), 3, to_run_config(config), raise_errors=True)
    start = model.load_policy(config).shared_arrays()
    result = strategy.start(grid, messages.pack_arrays(start), num_rounds=1)
    return start, messages.unpack_arrays(result.arrays), result


@pytest.mark.parametrize("strategy", [flower.FedMedian(), flower.FedAdam(eta=0.01)])
def test_flowers_own_server_trains_our_clients_without_any_sha_256(strategy, tiny, tools):
    start, end, result = stock(strategy, replace(tiny, normalisation="base"), tools)
    assert any((start[name] != end[name]).any() for name in start) and result.train_metrics_clientapp[1]["loss"] > 0
    assert result.evaluate_metrics_clientapp[1]["action_error"] > 0


def test_flowers_own_server_is_told_what_our_clients_need(tiny, tools):
    with pytest.raises(ValueError, match="give normalisation=base, own or none"):
        stock(flower.FedAvg(), tiny, tools)


def test_a_hash_that_a_server_announces_is_checked_and_one_of_several_must_not_lack():
    good = {"w": np.ones(2, np.float32)}
    content = messages.RecordDict({messages.CONFIG: ConfigRecord(), messages.ARRAYS: messages.pack_arrays(good)})
    also = (messages.ARRAYS, messages.CONTROL)
    content[messages.CONTROL] = messages.pack_arrays(good)
    read = [messages.checked_arrays(content, messages.CONFIG, {"w": (2,)}, one, also) for one in also]
    assert all((one["w"] == good["w"]).all() for one in read)
    messages.attach(content, messages.CONFIG, messages.ARRAYS, good)
    with pytest.raises(ValueError, match="no SHA-256 under config.sha256-control"):
        messages.checked_arrays(content, messages.CONFIG, {"w": (2,)}, messages.CONTROL, also)


WRONG = {
    "fedsgd": "one of fedavg",
    "my strategies:Trimmed": "module:Class of a Flower strategy",
    "no_such_module:Best": r"cannot be imported \(ModuleNotFoundError.*fab-include",
    "my_strategies:Best": "my_strategies has no class 'Best'",
    "my_strategies:NOTHING": "has no class 'NOTHING' derived from Flower's Strategy",
    "my_strategies:Greedy": "needs arguments: derive a class that gives them.*beta",
    "flwr.serverapp.strategy:Strategy": "needs arguments|abstract",
    "flwr.serverapp.strategy:FedXgbBagging": "combines decision trees",
}


@pytest.mark.parametrize("strategy", WRONG)
def test_a_strategy_that_cannot_be_brought_is_one_line_and_leaves_no_run(strategy, tiny, capsys, tmp_path):
    assert main(["run", "--profile", "tiny", "--strategy", strategy, "--out", str(tmp_path / "runs")]) == 2
    told = capsys.readouterr().err
    assert len(told.splitlines()) == 1 and not (tmp_path / "runs").exists()
    with pytest.raises(AssertionError, match=WRONG[strategy]):
        raise AssertionError(told)


def test_a_strategy_that_gives_up_ends_the_run_with_its_name(tiny, tools):
    with pytest.raises(TooFewReplies, match="strategy=my_strategies:Silent refused 3 replies"):
        run(replace(tiny, strategy="my_strategies:Silent"), tools)


def test_the_module_travels_in_the_bundle_unless_it_is_installed(tiny, tmp_path):
    app = app_bundle.stage_app(tmp_path / "one", replace(tiny, strategy="my_strategies:Trimmed"))
    bundle = zipfile.ZipFile(io.BytesIO(build_fab_from_disk(app)))
    assert bundle.read("my_strategies.py").decode() == BROUGHT
    package = Path("my_package")
    package.mkdir()
    (package / "__init__.py").write_text("from my_package.best import Best\n")
    (package / "best.py").write_text("from flwr.serverapp.strategy import FedAvg\n\n\nclass Best(FedAvg):\n    pass\n")
    app = app_bundle.stage_app(tmp_path / "two", replace(tiny, strategy="my_package:Best"))
    names = zipfile.ZipFile(io.BytesIO(build_fab_from_disk(app))).namelist()
    assert {"my_package/__init__.py", "my_package/best.py"} < set(names) and "my_strategies.py" not in names
    app = app_bundle.stage_app(tmp_path / "three", replace(tiny, strategy=STOCK[0]))
    assert sorted(path.name for path in app.iterdir()) == ["fedvla_lib", "pyproject.toml"]
