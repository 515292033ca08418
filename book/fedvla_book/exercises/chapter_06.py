"""Checks of the exercises in the chapter that compares federated with centralized training."""

from collections.abc import Callable, Sequence

import numpy as np

from fedvla_book.exercises import close, expect


def steps_spent(steps: Callable[[int, int, int, int], Sequence[int]]) -> None:
    """``steps(rounds, drawn, num_clients, local_steps)``: gradient steps of local-only, federated, centralized."""
    for rounds, drawn, num_clients, local_steps in ((10, 4, 10, 20), (200, 2, 10, 2), (3, 6, 6, 5)):
        given = steps(rounds, drawn, num_clients, local_steps)
        expect(np.shape(given) == (3,), "Return three numbers: local-only, federated, centralized.")
        alone, federated, centralized = given
        together, some_rest = rounds * drawn * local_steps, drawn < num_clients
        everyone = some_rest and federated == rounds * num_clients * local_steps
        expect(not everyone, "In a round only the sampled clients train.")
        case = f"{rounds} rounds, {drawn} of {num_clients} clients drawn, {local_steps} local steps"
        expect(federated == together, f"{case}: all clients of the federation together take {together} steps.")
        expect(centralized == federated, "Centralized takes as many as all clients of the federation together.")
        always = some_rest and alone == rounds * local_steps
        expect(not always, "A client is not sampled in every round, so a lab alone must not train as if it were.")
        expect(
            alone == together // num_clients,
            "Local-only takes what one client takes on average: divide by the number of clients.",
        )


def unpaired(find: Callable[[Sequence, Sequence], Sequence]) -> None:
    """``find(left, right)`` lists the (task, seed) that only one of two methods ran."""
    left = [("lift", 1), ("lift", 2), ("push", 1), ("push", 3)]
    right = [("lift", 2), ("lift", 1), ("push", 2), ("push", 1)]
    given = list(find(list(left), list(right)))
    pairs = all(isinstance(rollout, tuple | list) and len(rollout) == 2 for rollout in given)
    expect(pairs, "A rollout is a task and a seed: the same seed in another task is another rollout.")
    found = {tuple(rollout) for rollout in given}
    expect(found, "Equally many rollouts and the same tasks are not enough: look at each (task, seed).")
    shared = {("lift", 1), ("lift", 2), ("push", 1)}
    expect(not found & shared, "Both methods ran a rollout that you list: their order does not matter.")
    expect(len(found) == 2, "Both sides count: what only the left method ran, and what only the right method ran.")
    expect(not list(find(left, left[::-1])), "The same rollouts in another order can all be paired.")
    more = find(left, [*left, ("stack", 7)])
    expect([tuple(rollout) for rollout in more] == [("stack", 7)], "A method may also have run more than the other.")


def three_budgets(budgets: Callable[[int, int, int, float], Sequence[float]]) -> None:
    """``budgets(rounds, drawn, local_steps, mb)``: steps in all, steps in a row, MB in all; weights take ``mb``."""
    for rounds, drawn, local_steps, mb in ((40, 4, 5, 1.9), (10, 10, 40, 2.0), (200, 2, 2, 0.5)):
        given = budgets(rounds, drawn, local_steps, mb)
        expect(np.shape(given) == (3,), "Return three numbers: steps in all, steps in a row, MB in all.")
        in_all, in_a_row, sent = given
        case = f"{rounds}x{drawn}x{local_steps}"
        expect(in_a_row != in_all or drawn == 1, "Clients of a round train side by side, not in a row.")
        expect(in_a_row != local_steps, "The next round starts where the last one ended: rounds follow in a row.")
        expect(in_a_row == rounds * local_steps, f"{case}: every round adds the local steps of one client in a row.")
        expect(in_all == drawn * in_a_row, f"{case}: in all, the steps of every drawn client count.")
        expect(not close(sent, rounds * drawn * mb), "Weights travel down to a client and back up: twice.")
        expect(not close(sent, 2 * rounds * mb), "Every drawn client gets the weights and sends them back.")
        expect(close(sent, 2 * rounds * drawn * mb), f"{case}: count the transfers, then multiply by {mb} MB.")


def demonstrations_needed(needed: Callable[[Sequence[int], Sequence[float], float], float]) -> None:
    """``needed(counts, rates, wanted)``: demonstrations with which a lab alone succeeds at the rate wanted."""
    counts, rates = np.array([1, 2, 4, 8, 16]), np.array([0.1, 0.2, 0.4, 0.5, 0.7])
    for wanted, right in ((0.4, 4.0), (0.3, 2**1.5), (0.6, 2**3.5)):
        given = needed(counts, rates, wanted)
        expect(np.shape(given) == (), "Expected one number.")
        straight = np.interp(wanted, rates, counts)
        expect(not close(given, straight) or close(straight, right), "Linear in the logarithm, not in the count.")
        expect(not close(given, np.log2(right)), "That is the logarithm: turn it back into a count.")
        expect(close(given, right), f"At which count does the curve of labs alone pass {wanted}?")
    beyond = needed(counts, rates, 0.9)
    expect(not close(beyond, 16.0), "0.9 was not reached with 16: more are needed, and nobody knows how many.")
    expect(beyond == np.inf, "Beyond what was measured the curve is unknown: return infinity.")
    expect(close(needed(counts, rates, 0.05), 1.0), "If the smallest count suffices, it is the answer.")
