"""Demonstrations: record them, read anybody's, split and partition episodes, normalise, and make training batches.

May import `robot`, LeRobot's data sets and torch. Knows no policy and no federation. Start reading with `record`, then
`batches`; who holds which episodes is in `splits` and `partition`.
"""
