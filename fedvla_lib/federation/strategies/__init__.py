"""Strategies: how the server aggregates updates, and what two of them do on the client's side.

May import Flower's strategies, and torch where the client side changes gradients (`fedprox`, `scaffold`). Start reading
with `checked`, the base of all strategies; `build` returns the one that the settings name.
"""
