"""Mistakes that readers make in the chapter on local training, and a word of the hint that each gets."""

RESUMABLE = """
def resumable(weights, gradient, num_steps, state):
    first, momentum = {begin}
    for step in range(first, first + num_steps):
        momentum = 0.9 * momentum + gradient(weights)
        weights = weights - 0.1 / (1 + step) * momentum
    return weights, {kept}
"""
IN_PLACE = """
def resumable(weights, gradient, num_steps, state):
    first, momentum = state or (0, np.zeros(weights.shape))
    for step in range(first, first + num_steps):
        momentum *= 0.9
        momentum += gradient(weights)
        weights = weights - 0.1 / (1 + step) * momentum
    return weights, (first + num_steps, momentum)
"""
ROUNDED = """
def resumable(weights, gradient, num_steps, state):
    first, momentum = state or (0, np.zeros(weights.shape))
    for step in range(first, first + num_steps):
        momentum = 0.9 * momentum + gradient(weights)
        weights = weights - 0.1 / (1 + step) * momentum
    return weights, (first + num_steps, momentum.astype(np.float32))
"""
DENOISED = """
def denoised(velocity, noise, num_steps):
    x = noise{copy}
    for t in {times}:
        {move}
    return x
"""
ERRORS = """
def two_errors(policy, states_deg):
    goals = states_deg[1:]
    recorded = np.array([policy(state) for state in states_deg[:-1]])
    own, state = [], {begin}
    for {each}:
        state = policy(state)
        own.append(state)
    return {first}, {second}
"""
ERROR_PARTS = {
    "begin": "states_deg[0]",
    "each": "_ in goals",
    "first": "np.abs(recorded - goals).mean()",
    "second": "np.abs(own - goals).mean()",
}
COUNTING_DOWN = "np.arange(num_steps, 0, -1) / num_steps"
STEP = "x = x - velocity(x, t) / num_steps"


def _loss(lines):
    return f"def flow_loss(velocity, noise, action, is_pad):\n    {lines}"


def _count(value):
    return f"def upload_mb(parameters, trains, num_clients, num_rounds):\n    return {value}"


def _walk(times=COUNTING_DOWN, move=STEP, copy=""):
    return DENOISED.format(times=times, move=move, copy=copy)


def _errors(**changed):
    return ERRORS.format(**(ERROR_PARTS | changed))


WRONG = {
    "upload_mb": [
        (_count("4 * parameters.sum() * num_clients * num_rounds / 1e6"), "Frozen"),
        (_count("parameters[trains].sum() * num_clients * num_rounds / 1e6"), "four bytes"),
        (_count("4 * parameters[trains].sum() * num_clients * num_rounds"), "a million of them"),
        (_count("4 * parameters[trains].sum() / 1e6"), "one upload"),
        (_count("4 * parameters[trains].sum() * num_clients * num_rounds / 2**20"), "over a million"),
        (_count("4 * parameters[1:].sum() * num_clients * num_rounds / 1e6"), "`trains`"),
    ],
    "flow_loss": [
        (_loss("return ((velocity - (noise - action)) ** 2).mean()"), "Padding is still in"),
        (_loss("return (((velocity - (noise - action)) ** 2) * ~is_pad[..., None]).mean()"), "still in the number"),
        (_loss("return ((velocity - (action - noise)) ** 2)[~is_pad].mean()"), "The sign"),
        (_loss("return ((velocity - (noise - action)) ** 2)[~is_pad].sum() / (~is_pad).sum()"), "joints"),
        (_loss("return np.abs(velocity - (noise - action))[~is_pad].mean()"), "Square"),
        (_loss("return ((velocity - (noise - action)) ** 2)[~is_pad].mean(axis=0)"), "shape (6,)"),
        (
            _loss(
                "squares = (velocity - (noise - action)) ** 2\n"
                "    return np.mean([one[~pad].mean() for one, pad in zip(squares, is_pad)])"
            ),
            "within a sample",
        ),
    ],
    "denoised": [
        (_walk(move="x -= velocity(x, t) / num_steps"), "work on a copy"),
        (_walk("np.linspace(1, 0, num_steps + 1)"), "evaluate it 5 times"),
        (_walk("np.arange(num_steps) / num_steps"), "Start at t = 1"),
        (_walk("np.linspace(1, 0, num_steps)"), "equally long"),
        (_walk(move="x = x - velocity(noise, t) / num_steps"), "at the current point, not"),
        (_walk(move="x = x + velocity(x, t) / num_steps"), "against the velocity"),
        (_walk(move="x = x - velocity(x, t)"), "the whole velocity"),
        (_walk("(1.0, 0.75, 0.5, 0.25)"), "5 steps"),
        (_walk(move="x = x - t * velocity(x, t) / num_steps"), "length of a step"),
    ],
    "resumable": [
        (RESUMABLE.format(begin="0, 0.0", kept="None"), "starts from zero"),
        (RESUMABLE.format(begin="state or 0, 0.0", kept="first + num_steps"), "momentum starts at zero"),
        (RESUMABLE.format(begin="0, state if state is not None else 0.0", kept="momentum"), "step number belongs"),
        (
            RESUMABLE.replace("0.9 * momentum + ", "").format(begin="state or (0, 0.0)", kept="(1, 0.0)"),
            "even without a stop",
        ),
        (RESUMABLE.format(begin="0, 0.0", kept="step, momentum"), "two things"),
        (ROUNDED, "the same bits"),
        (IN_PLACE, "its contents"),
        (IN_PLACE.replace("weights = weights - ", "weights -= ").replace("*=", "= momentum *"), "its contents"),
    ],
    "two_errors": [
        (_errors(first="np.abs(recorded - states_deg[:-1]).mean()"), "*next* state"),
        (_errors(first="(recorded - goals).mean()"), "must not cancel"),
        (_errors(first="np.abs(recorded - goals).max()"), "each recorded state"),
        (_errors(second="np.abs(recorded - goals).mean()"), "queries recorded states too"),
        (_errors(second="np.abs(own - goals)[-1]"), "not the error at the end"),
        (_errors(begin="states_deg[1]"), "start at the first state"),
        (_errors(second="0.0").replace("return", "return 0.0,"), "Return two numbers"),
    ],
}
