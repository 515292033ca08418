"""How a server combines what clients send: one strategy a file, with the client's half where it has one.

May import Flower's strategies, and torch where a client's half changes gradients (`fedprox`, `scaffold`). Start reading
with `checked`, which all strategies share; `build` picks the one that the settings name.
"""
