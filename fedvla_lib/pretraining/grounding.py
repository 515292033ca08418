"""Pretrain the vision-language part on phrase grounding: where on the table is "the red cube"?

SmolVLA starts from a vision-language model pretrained on millions of captions and boxes. The nano model starts from
random weights, and demonstrations are a weak signal for the meaning of words. So it first learns phrase grounding
(GLIP, arXiv:2112.03857) on rendered scenes. Linear probes read the answers from the values of the prefix, which the
action expert attends to: from an image token, what is in its cell of the image; from a token of a phrase, where the
named object is. The probes are removed afterwards.
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
from fedvla_lib.pretraining.scenes import OBJECTS, Scenes
from fedvla_lib.robot.spec import NUM_JOINTS, STATE_KEY, image_key

OPENINGS = ("", "Find ", "Look at ", "Where is ", "Here is ", "Look for ")  # none is used in a task
BETWEEN = (" and ", ", ", " near ", " beside ")
MOST_NAMED = 3  # objects in one sentence
NAMED, PRESENT, PLACES = "named", "present", "places"  # keys of the targets in a batch
CENTRE_M, SCALE_M = (0.17, 0.0), 0.1  # places are relative to the middle of the workspace, in decimetres
ROUGH = 0.1  # beta of the smooth L1 loss, in decimetres
RARE = 5.0  # weight of positive cells: most cells are empty
PRESENCE_WEIGHT = 3.0  # weight of the presence loss relative to the place losses


@dataclass(frozen=True, eq=False)
class Questions:
    """Training batches of scenes with sentences; `at(step)` depends on the fields and the step only."""

    scenes: Scenes
    bundle: Bundle  # for its tokenizer
    batch_size: int
    seed: int

    @property
    def num_examples(self) -> int:
        """Return the number of scenes."""
        return len(self.scenes.places_m)

    def at(self, step: int) -> dict[str, Any]:
        """Return the raw batch of a gradient step, with augmented images and its targets."""
        rng = np.random.default_rng([self.seed, ORDER_STREAM, step])
        rows = rng.integers(self.num_examples, size=self.batch_size)
        raw = {camera: images[rows] for camera, images in self.scenes.images.items()}
        return self._batch(rows, augmented(raw, np.random.default_rng([self.seed, AUGMENT_STREAM, step])), rng)

    def plain(self, rows: np.ndarray) -> dict[str, Any]:
        """Return the batch of these scenes without augmentation; the sentences depend on the seed only."""
        images = {camera: to_float(images[rows]) for camera, images in self.scenes.images.items()}
        return self._batch(rows, images, np.random.default_rng(self.seed))

    def _batch(self, rows: np.ndarray, images: dict[str, torch.Tensor], rng: np.random.Generator) -> dict[str, Any]:
        places_m = self.scenes.places_m[rows]
        texts, named = [], []
        for row, present in enumerate(np.isfinite(places_m[..., 0])):
            text, phrases = sentence(np.flatnonzero(present), rng)
            texts.append(text)
            named += [(row, token, obj) for obj, token in self._tokens(text, phrases)]
        places = (np.nan_to_num(places_m) - CENTRE_M) / SCALE_M
        return {
            **{image_key(camera): image for camera, image in images.items()},
            STATE_KEY: torch.zeros(len(rows), NUM_JOINTS),  # unused: words do not attend to the later state
            "task": texts,
            NAMED: torch.tensor(named),  # (phrase tokens, 3): row, token, object
            PRESENT: torch.from_numpy(in_cells(self.scenes.shares[rows], self._cells)),  # (B, image tokens, objects)
            PLACES: torch.from_numpy(places.astype(np.float32)),  # (B, objects, 2)
        }

    @cached_property
    def _cells(self) -> int:
        """Image tokens along one side of an image."""
        vision = self.bundle.policy.model.vlm_with_expert.config
        return vision.vision_config.image_size // vision.vision_config.patch_size // vision.scale_factor

    def _tokens(self, text: str, phrases: list[tuple[int, int, int]]) -> Iterator[tuple[int, int]]:
        """Yield (object, index of the token in the instruction) for each token of each phrase."""
        tokenizer = self.bundle.policy.model.vlm_with_expert.processor.tokenizer
        pieces = tokenizer(text, return_offsets_mapping=True)["offset_mapping"]
        for obj, start, end in phrases:
            yield from ((obj, k) for k, (first, last) in enumerate(pieces) if first < end and last > start)


def sentence(present: np.ndarray, rng: np.random.Generator) -> tuple[str, list[tuple[int, int, int]]]:
    """Return a sentence that names some of the objects `present`, and (object, start, end) of each phrase in it."""
    count = int(rng.integers(1, min(MOST_NAMED, len(present)) + 1))
    text, phrases = OPENINGS[rng.integers(len(OPENINGS))], []
    for place, obj in enumerate(rng.permutation(present)[:count]):
        text += (BETWEEN[rng.integers(len(BETWEEN))] if place else "") + "the "
        phrases.append((int(obj), len(text), len(text) + len(OBJECTS[obj])))
        text += OBJECTS[obj]
    return text + ".", phrases


def in_cells(shares: np.ndarray, side: int) -> np.ndarray:
    """Return which objects are in which cells: (B, cameras, objects, 2) -> float32 (B, cameras * side², objects)."""
    seen = ((shares >= 0) & (shares < 1)).all(axis=-1)  # False for NaN: not in the scene
    columns, rows = np.moveaxis(np.floor(np.nan_to_num(shares) * side).astype(int), -1, 0)
    marks = np.zeros((*seen.shape[:2], side * side, seen.shape[2]), np.float32)
    image, camera, obj = np.nonzero(seen)
    marks[image, camera, (rows * side + columns)[seen], obj] = 1
    return marks.reshape(len(shares), -1, seen.shape[2])


@contextmanager
def probing(bundle: Bundle, seed: int) -> Iterator[None]:
    """Add the linear probes to the policy, as trainable parameters, for the duration of the context."""
    text = bundle.policy.model.vlm_with_expert.config.text_config
    width = text.num_key_value_heads * text.head_dim
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        probes = {"cell": torch.nn.Linear(width, len(OBJECTS) * 3)}  # presence, and x and y on the table
        probes |= {f"phrase_{layer}": torch.nn.Linear(width, 2) for layer in _read_layers(bundle)}
    bundle.policy.probes = torch.nn.ModuleDict(probes).to(bundle.policy.config.device)
    try:
        yield
    finally:
        del bundle.policy.probes


def grounding_loss(bundle: Bundle, batch: dict[str, Any]) -> torch.Tensor:
    """Return the loss of the probes: what is in each cell, and where each named object is."""
    values, pointed = _answers(bundle, batch)
    batch_size, cells, objects = batch[PRESENT].shape
    answers = bundle.policy.probes["cell"](values[0][:, :cells]).view(batch_size, cells, objects, 3)
    present, places = batch[PRESENT].to(answers.device), batch[PLACES].to(answers.device)
    presence = binary_cross_entropy_with_logits(answers[..., 0], present, pos_weight=answers.new_tensor(RARE))
    wanted = places[:, None].expand(-1, cells, -1, -1)[present > 0]
    located = smooth_l1_loss(answers[..., 1:][present > 0], wanted, beta=ROUGH)
    row, _, obj = batch[NAMED].T
    named = sum(smooth_l1_loss(place, places[row, obj], beta=ROUGH) for place in pointed)
    return PRESENCE_WEIGHT * presence + located + named


@torch.no_grad()
def pointing_error_m(bundle: Bundle, questions: Questions, batch_size: int = 100) -> np.ndarray:
    """Return the distance in metres from the last probe's answer to the named object, float64 (phrase tokens,)."""
    bundle.policy.eval()
    errors = []
    for start in range(0, questions.num_examples, batch_size):
        batch = questions.plain(np.arange(start, min(start + batch_size, questions.num_examples)))
        row, _, obj = batch[NAMED].T
        missed = _answers(bundle, batch)[1][-1].cpu() - batch[PLACES][row, obj]
        errors.append(SCALE_M * missed.norm(dim=-1).double().numpy())
    return np.concatenate(errors)


def _answers(bundle: Bundle, batch: dict[str, Any]) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """The values of the prefix, (B, L, width) per layer, and the probes' answers at phrase tokens, (n, 2) per probe."""
    raw = {key: value for key, value in batch.items() if key not in (NAMED, PRESENT, PLACES)}
    keys_and_values, _ = prefill(bundle, raw)  # (B, layers, 2, heads, L, head dim)
    values = [layer.transpose(1, 2).flatten(2) for layer in keys_and_values[:, :, 1].unbind(1)]
    row, token, _ = batch[NAMED].T
    place = batch[PRESENT].shape[1] + token  # image tokens come first, then words
    probes = bundle.policy.probes
    return values, [probes[f"phrase_{layer}"](values[layer][row, place]) for layer in _read_layers(bundle)]


def _read_layers(bundle: Bundle) -> list[int]:
    """Layers with cross-attention from the action expert, which can use what their values hold."""
    model = bundle.policy.model.vlm_with_expert
    return [layer for layer in range(model.num_vlm_layers) if layer % model.self_attn_every_n_layers]
