"""Mistakes that readers make in the chapter on federated averaging, and a word of the hint that each gets."""

ROUND = """
def federated_round(parts, weights, rate, local_steps):
    ends = []
    for x, y in parts:
        w = weights
        for _ in range(local_steps):
            {step}
        ends.append({end})
    return np.average(ends, axis=0, weights={by})
"""
CHAINED = """
def federated_round(parts, weights, rate, local_steps):
    ends = []
    for x, y in parts:
        for _ in range(local_steps):
            weights = weights - rate * x.T @ (x @ weights - y) / len(y)
        ends.append(weights)
    return {result}
"""
POOLED = """
def federated_round(parts, weights, rate, local_steps):
    x, y = (np.concatenate(values) for values in zip(*parts))
    for _ in range(local_steps):
        weights = weights - rate * x.T @ (x @ weights - y) / len(y)
    return weights
"""
SURVIVING = """
def surviving(start, updates, frames):
    moves = np.stack([np.concatenate([({move}).ravel() for n in start]) for u in updates])
    shares = {shares}
    return {share}
"""
BY_ARRAY = """
def surviving(start, updates, frames):
    shares, found = np.array(frames) / sum(frames), []
    for name in start:
        moves = np.stack([(u[name] - start[name]).ravel() for u in updates])
        found.append(np.linalg.norm(shares @ moves) / (shares @ np.linalg.norm(moves, axis=1)))
    return np.mean(found)
"""
COSINES = """
def surviving(start, updates, frames):
    moves = np.stack([np.concatenate([(u[n] - start[n]).ravel() for n in start]) for u in updates])
    norms = np.linalg.norm(moves, axis=1)
    return (moves @ moves.T / np.outer(norms, norms)).mean()
"""
PART = {
    "move": "u[n] - start[n]",
    "shares": "np.array(frames) / sum(frames)",
    "share": "np.linalg.norm(shares @ moves) / (shares @ np.linalg.norm(moves, axis=1))",
}
LOSSES = """
def round_losses(events):
    sums, frames = {{}}, {{}}
    for event in events:
        if {wanted}:
            number, values = event["round"], event["values"]
            n = {n}
            sums[number] = sums.get(number, 0) + n * values["loss"]
            frames[number] = frames.get(number, 0) + n
    return {returned}
"""
STEP = "w = w - rate * x.T @ (x @ w - y) / len(y)"


def _average(lines):
    return f"def good_average(updates, frames):\n    {lines}"


def _kept(test, divisor, n="n"):
    return _average(
        f"good = [(u, n) for u, n in zip(updates, frames) if {test}]\n"
        f"    return sum({n} * u for u, n in good) / {divisor}"
    )


def _rounds(value):
    return f"def rounds_within(budget_mb, parameters, trainers, evaluators):\n    return {value}"


def _losses(wanted='event["kind"] == "train"', n='values["num_examples"]', returned=None):
    returned = returned or "{number: sums[number] / frames[number] for number in sums}"
    return LOSSES.format(wanted=wanted, n=n, returned=returned)


def _round(step=STEP, end="w", by="[len(y) for _, y in parts]"):
    return ROUND.format(step=step, end=end, by=by)


def _surviving(**changed):
    return SURVIVING.format(**(PART | changed))


WRONG = {
    "good_average": [
        (_average("return sum(n * u for u, n in zip(updates, frames)) / sum(frames)"), "whole reply"),
        (_average("return sum(n * np.nan_to_num(u) for u, n in zip(updates, frames)) / sum(frames)"), "whole reply"),
        (
            _average(
                "kept = [n * bool(np.isfinite(u).all()) for u, n in zip(updates, frames)]\n"
                "    return sum(n * u for u, n in zip(updates, kept)) / sum(kept)"
            ),
            "zero times NaN",
        ),
        (_kept("np.isfinite(u).all()", "sum(frames)"), "add up to 1"),
        (_kept("np.isfinite(u).all()", "len(good)", "1"), "more frames"),
        (_kept("np.isfinite(u).all()", "1"), "finite values only"),
        (_kept("not np.isnan(u).any()", "sum(n for _, n in good)"), "infinite"),
        (_average("return 2.0"), "shape ()"),
    ],
    "rounds_within": [
        (_rounds("int(budget_mb * 1e6 // (4 * parameters * 2 * trainers))"), "receives the weights"),
        (_rounds("int(budget_mb * 1e6 // (4 * parameters * 2 * (trainers + evaluators)))"), "sends numbers back"),
        (_rounds("int(budget_mb * 1e6 // (4 * parameters * trainers))"), "are sent down"),
        (_rounds("int(budget_mb * 1e6 // (4 * parameters * (trainers + evaluators)))"), "count the upload"),
        (_rounds("int(budget_mb * 1e6 // (parameters * (2 * trainers + evaluators)))"), "four bytes"),
        (_rounds("round(budget_mb * 1e6 / (4 * parameters * (2 * trainers + evaluators)))"), "complete rounds"),
        (_rounds("budget_mb * 1e6 / (4 * parameters * (2 * trainers + evaluators))"), "complete rounds"),
        (_rounds("int(budget_mb // (4 * parameters * (2 * trainers + evaluators)))"), "sends the weights twice"),
        (_rounds("int((budget_mb * 1e6 - 1) // (4 * parameters * (2 * trainers + evaluators)))"), "exactly"),
    ],
    "round_losses": [
        (_losses(wanted='"loss" in event["values"]'), "In round 0"),
        (_losses(wanted='"loss" in event["values"] and event["round"]'), "kind train"),
        (_losses(wanted="True"), "KeyError"),
        (_losses(n="1"), "counts more"),
        (_losses(returned="{number: sums[number] / 600 for number in sums}"), "not of all"),
        (_losses(returned="[sums[number] / frames[number] for number in sums]"), "a dict"),
        (_losses(returned="{1: sums[1] / frames[1]}"), "one entry"),
        (_losses(returned="{i: sums[n] / frames[n] for i, n in enumerate(sums, 1)}"), "need not"),
    ],
    "federated_round": [
        (_round(by="None"), "by their frames"),
        (CHAINED.format(result="np.average(ends, axis=0, weights=[len(y) for _, y in parts])"), "another stopped"),
        (CHAINED.format(result="np.mean(ends, axis=0)"), "another stopped"),
        (CHAINED.format(result="ends[-1]"), "another stopped"),
        (_round(step="w -= rate * x.T @ (x @ w - y) / len(y)"), "overwrite"),
        (_round(step="w = w - rate * x.T @ (x @ w - y)"), "one step on all data"),
        (POOLED, "clients diverge"),
        (_round(step="w = weights - rate * x.T @ (x @ weights - y) / len(y)"), "in a row"),
    ],
    "surviving": [
        (_surviving(move="u[n]"), "subtract the start"),
        (_surviving(shares="np.ones(len(updates)) / len(updates)"), "by their frames"),
        (_surviving(share="shares @ np.linalg.norm(moves, axis=1) / np.linalg.norm(shares @ moves)"), "inverted"),
        (BY_ARRAY, "not one for each array"),
        (COSINES, "the mean of the norms"),
    ],
}
