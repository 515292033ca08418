"""Checks of the exercises in the chapter on partitioning."""

from collections.abc import Callable, Sequence

import numpy as np

from fedvla_book.exercises import close, expect


def dealt(deal: Callable[[Sequence[int], int], list[list[int]]]) -> None:
    """``deal(episode_ids, num_clients)`` deals episodes out in turn, in ascending order of their ids."""
    ids = [12, 0, 6, 3, 9, 15, 21]
    parts = [list(part) for part in deal(list(ids), 3)]
    expect(len(parts) == 3, f"There are 3 clients, and you return {len(parts)} lists.")
    everything = [episode for part in parts for episode in part]
    expect(sorted(everything) == sorted(ids), "Each episode must belong to exactly one client.")
    sizes = sorted(len(part) for part in parts)
    expect(sizes[-1] - sizes[0] <= 1, "One client has far more: deal by the position in the list, not by the id.")
    expect(parts == [[0, 9, 21], [3, 12], [6, 15]], "Sort the ids first, then go round: first, second, third, first...")


def pooled_std(pool: Callable[..., np.ndarray]) -> None:
    """``pool(frames, means, stds)`` is the standard deviation of all frames, from each client's own statistics."""
    rng = np.random.default_rng(2)
    clients = [rng.normal(10 * k, 1 + k, (20 * (k + 1), 6)) for k in range(3)]
    frames = np.array([len(values) for values in clients])
    means, stds = (np.stack([f(values, axis=0) for values in clients]) for f in (np.mean, np.std))
    given, right = pool(frames, means, stds), np.concatenate(clients).std(axis=0)
    expect(np.shape(given) == (6,), f"Expected one value for each of the 6 joints, not the shape {np.shape(given)}.")
    inside = np.sqrt((frames @ stds**2) / frames.sum())
    expect(not close(given, right**2), "That is the variance: take the root.")
    expect(np.mean(given) > 1.05 * inside.mean(), "Too small: the spread between the clients' means is left out.")
    expect(close(given, right), "Nearly: a client with more frames must count more, in both terms and in the mean.")


def lacking(count: Callable[[np.ndarray], int]) -> None:
    """``count(held)`` is how many clients lack a task; `held` counts episodes, clients x tasks."""
    held = np.array([[3, 0, 0], [1, 2, 5], [0, 4, 1], [2, 2, 2]])
    given = count(held)
    expect(given != (held == 0).sum(), "You count missing tasks; count the clients that miss any.")
    expect(given != 2 or count(np.zeros((2, 3), dtype=int)) == 2, "A client without any episode lacks tasks, too.")
    expect(given == 2, "Look at a row at a time: does any task have no episode?")


def total_variation(measure: Callable[[np.ndarray], float]) -> None:
    """``measure(held)`` is the distance between each client's mix of tasks and the common one, averaged by episodes."""
    held = np.array([[8, 0, 0], [2, 2, 2], [0, 5, 5]])
    sizes, common = held.sum(axis=1), held.sum(axis=0) / held.sum()
    each = np.abs(held / sizes[:, None] - common).sum(axis=1) / 2
    given = measure(held)
    expect(not close(given, 2 * (sizes @ each) / sizes.sum()), "Each difference counts twice: halve the sum.")
    expect(not close(given, each.mean()), "A client with more episodes must weigh more in the average.")
    expect(close(given, (sizes @ each) / sizes.sum()), "Compare each client's shares of tasks with those of all.")
    alike = measure(np.array([[4, 2], [2, 1]]))
    expect(close(alike, 0.0), "Clients with the same shares have distance 0, however many episodes they have.")
