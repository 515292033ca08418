"""Demonstrations: record or read them, split and partition episodes, normalise, and make training batches.

May import `robot`, LeRobot's data sets and torch. Does not know policies or federation. Start reading with `record`,
then `batches`; `splits` and `partition` assign the episodes to clients.
"""
