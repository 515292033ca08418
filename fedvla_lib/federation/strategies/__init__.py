"""Strategies: how the server aggregates updates. One file each, with the client side if there is one.

May import Flower's strategies, and torch where the client side changes gradients (`fedprox`, `scaffold`). Start reading
with `checked`, the base of all strategies; `build` returns the one that the settings name.
"""
