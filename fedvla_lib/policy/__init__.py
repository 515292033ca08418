"""SmolVLA: build or load a policy, select the parameters to train, train it, and run it on observations.

May import `data`, `robot`, torch and LeRobot's policies. Does not know the federation: a client and centralized
training call the same `training.local_train`. Start reading with `model`, then `training`.
"""
