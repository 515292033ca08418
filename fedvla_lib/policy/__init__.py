"""SmolVLA: build or load it, choose what trains, train it, and let it act.

May import `data` and `robot`, torch and LeRobot's policies. Knows no federation: a client and a pooled training call
the same `training.local_train`. Start reading with `model`, then `training`.
"""
