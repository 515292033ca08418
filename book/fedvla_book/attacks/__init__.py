"""What updates and models give away, attacked with what the server has: each attack says what it must know.

The curious server follows the protocol and looks at every update that arrives. The curious client sees the global model
of each round, like everyone in the federation. TLS and node keys protect against neither.
"""
