"""Teach the vision-language part what words mean, before any action: where on the table is "the red cube"?

SmolVLA starts from a vision-language model that has read captions and boxes by the million. The nano model starts from
random weights, and demonstrations alone teach it slowly: that "red" has to do with what the arm should do is one thin
signal in a long chunk. So it first learns phrase grounding (GLIP, arXiv:2112.03857) on rendered scenes with sentences
that name things in them. Linear probes read the answers from the values of the prefix, which is where the action expert
reads too: every image token tells what lies in its cell of the picture, every token of a phrase where the named thing
is. Afterwards the probes are dropped.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch.nn.functional import binary_cross_entropy_with_logits, smooth_l1_loss

from fedvla_lib.data.augmentation import augmented, to_float
from fedvla_lib.data.batches import AUGMENT_STREAM, ORDER_STREAM
from fedvla_lib.policy.model import Bundle
from fedvla_lib.policy.prefix_cache import prefill
from fedvla_lib.pretraining.scenes import THINGS, Scenes
from fedvla_lib.robot.spec import NUM_JOINTS, STATE_KEY, image_key

OPENINGS = ("", "Find ", "Look at ", "Where is ", "Here is ", "Look for ")  # none is a word of a task
BETWEEN = (" and ", ", ", " near ", " beside ")
MOST_NAMED = 3  # things in one sentence
NAMED, PRESENT, PLACES = "named", "present", "places"  # in a batch: what the answers are
CENTRE_M, SCALE_M = (0.17, 0.0), 0.1  # places are measured from the middle of the table's used part, in decimetres
ROUGH = 0.1  # in decimetres: errors above this count by their size, below by their square
RARE = 5.0  # weight of a thing that is there against one that is not: most cells are empty
PRESENCE_WEIGHT = 3.0  # of the image tokens' yes and no against the places


@dataclass(frozen=True, eq=False)
class Questions:
    """Training batches of scenes with sentences; `at(step)` is a pure function of the fields and the step."""

    scenery: Scenes
    bundle: Bundle  # whose tokenizer cuts the sentences
    batch_size: int
    seed: int

    @property
    def num_examples(self) -> int:
        """Number of scenes."""
        return len(self.scenery.places_m)

    def at(self, step: int) -> dict[str, Any]:
        """Return the raw batch of a step, pictures augmented, with its answers."""
        rng = np.random.default_rng([self.seed, ORDER_STREAM, step])
        rows = rng.integers(self.num_examples, size=self.batch_size)
        pictures = {camera: images[rows] for camera, images in self.scenery.images.items()}
        images = augmented(pictures, np.random.default_rng([self.seed, AUGMENT_STREAM, step]))
        return self._batch(rows, images, rng)

    def plain(self, rows: np.ndarray) -> dict[str, Any]:
        """Return the batch of these scenes, pictures as they are; the sentences are fixed by the seed."""
        images = {camera: to_float(images[rows]) for camera, images in self.scenery.images.items()}
        return self._batch(rows, images, np.random.default_rng(self.seed))

    def _batch(self, rows: np.ndarray, images: dict[str, torch.Tensor], rng: np.random.Generator) -> dict[str, Any]:
        places_m = self.scenery.places_m[rows]
        texts, named = [], []
        for row, there in enumerate(np.isfinite(places_m[..., 0])):
            text, phrases = sentence(np.flatnonzero(there), rng)
            texts.append(text)
            named += [(row, token, thing) for thing, token in self._tokens(text, phrases)]
        places = (np.nan_to_num(places_m) - CENTRE_M) / SCALE_M
        return {
            **{image_key(camera): image for camera, image in images.items()},
            STATE_KEY: torch.zeros(len(rows), NUM_JOINTS),  # comes after the words, which do not look at it
            "task": texts,
            NAMED: torch.tensor(named),  # (phrase tokens, 3): row, token, thing
            PRESENT: torch.from_numpy(in_cells(self.scenery.shares[rows], self._cells)),  # (B, image tokens, things)
            PLACES: torch.from_numpy(places.astype(np.float32)),  # (B, things, 2)
        }

    @cached_property
    def _cells(self) -> int:
        """Image tokens along one side of a picture."""
        vision = self.bundle.policy.model.vlm_with_expert.config
        return vision.vision_config.image_size // vision.vision_config.patch_size // vision.scale_factor

    def _tokens(self, text: str, phrases: list[tuple[int, int, int]]) -> Iterator[tuple[int, int]]:
        """Yield the tokens of each phrase, as (thing, place of the token among the words)."""
        tokenizer = self.bundle.policy.model.vlm_with_expert.processor.tokenizer
        pieces = tokenizer(text, return_offsets_mapping=True)["offset_mapping"]
        for thing, start, end in phrases:
            yield from ((thing, k) for k, (first, last) in enumerate(pieces) if first < end and last > start)


def sentence(there: np.ndarray, rng: np.random.Generator) -> tuple[str, list[tuple[int, int, int]]]:
    """Return a sentence that names some of the things `there`, and (thing, start, end) of each phrase in it."""
    count = int(rng.integers(1, min(MOST_NAMED, len(there)) + 1))
    text, phrases = OPENINGS[rng.integers(len(OPENINGS))], []
    for place, thing in enumerate(rng.permutation(there)[:count]):
        text += (BETWEEN[rng.integers(len(BETWEEN))] if place else "") + "the "
        phrases.append((int(thing), len(text), len(text) + len(THINGS[thing])))
        text += THINGS[thing]
    return text + ".", phrases


def in_cells(shares: np.ndarray, side: int) -> np.ndarray:
    """Mark what is in which cell: shares (B, cameras, things, 2) -> float32 (B, cameras * side * side, things)."""
    seen = ((shares >= 0) & (shares < 1)).all(axis=-1)  # what is absent (NaN) is not seen
    columns, rows = np.moveaxis(np.floor(np.nan_to_num(shares) * side).astype(int), -1, 0)
    marks = np.zeros((*seen.shape[:2], side * side, seen.shape[2]), np.float32)
    picture, camera, thing = np.nonzero(seen)
    marks[picture, camera, (rows * side + columns)[seen], thing] = 1
    return marks.reshape(len(shares), -1, seen.shape[2])


@contextmanager
def probing(bundle: Bundle, seed: int) -> Iterator[None]:
    """Give the policy the linear probes, as part of what trains, for as long as the context lasts."""
    text = bundle.policy.model.vlm_with_expert.config.text_config
    width = text.num_key_value_heads * text.head_dim
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        probes = {"cell": torch.nn.Linear(width, len(THINGS) * 3)}  # is it here, and where on the table
        probes |= {f"phrase_{layer}": torch.nn.Linear(width, 2) for layer in _read_layers(bundle)}
    bundle.policy.probes = torch.nn.ModuleDict(probes).to(bundle.policy.config.device)
    try:
        yield
    finally:
        del bundle.policy.probes


def grounding_loss(bundle: Bundle, batch: dict[str, Any]) -> torch.Tensor:
    """Error of the probes: what is in each cell, and where each named thing is."""
    values, found = _answers(bundle, batch)
    batch_size, cells, things = batch[PRESENT].shape
    told = bundle.policy.probes["cell"](values[0][:, :cells]).view(batch_size, cells, things, 3)
    present, places = batch[PRESENT].to(told.device), batch[PLACES].to(told.device)
    is_there = binary_cross_entropy_with_logits(told[..., 0], present, pos_weight=told.new_tensor(RARE))
    wanted = places[:, None].expand(-1, cells, -1, -1)[present > 0]
    where = smooth_l1_loss(told[..., 1:][present > 0], wanted, beta=ROUGH)
    row, _, thing = batch[NAMED].T
    named = sum(smooth_l1_loss(place, places[row, thing], beta=ROUGH) for place in found)
    return PRESENCE_WEIGHT * is_there + where + named


@torch.no_grad()
def pointing_error_m(bundle: Bundle, questions: Questions, batch_size: int = 100) -> np.ndarray:
    """Return how far from a named thing the last probe points, in metres, float64 (n,): one number a phrase token."""
    bundle.policy.eval()
    errors = []
    for start in range(0, questions.num_examples, batch_size):
        batch = questions.plain(np.arange(start, min(start + batch_size, questions.num_examples)))
        row, _, thing = batch[NAMED].T
        missed = _answers(bundle, batch)[1][-1].cpu() - batch[PLACES][row, thing]
        errors.append(SCALE_M * missed.norm(dim=-1).double().numpy())
    return np.concatenate(errors)


def _answers(bundle: Bundle, batch: dict[str, Any]) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """The values of the prefix, (B, L, width) for each layer, and where the tokens of phrases point, (n, 2) each."""
    raw = {key: value for key, value in batch.items() if key not in (NAMED, PRESENT, PLACES)}
    keys_and_values, _ = prefill(bundle, raw)  # (B, layers, 2, heads, L, head dim)
    values = [layer.transpose(1, 2).flatten(2) for layer in keys_and_values[:, :, 1].unbind(1)]
    row, token, _ = batch[NAMED].T
    place = batch[PRESENT].shape[1] + token  # the tokens of the pictures come first, then the words
    probes = bundle.policy.probes
    return values, [probes[f"phrase_{layer}"](values[layer][row, place]) for layer in _read_layers(bundle)]


def _read_layers(bundle: Bundle) -> list[int]:
    """Layers whose values the action expert attends to from outside: where an answer is of use to it."""
    model = bundle.policy.model.vlm_with_expert
    return [layer for layer in range(model.num_vlm_layers) if layer % model.self_attn_every_n_layers]
