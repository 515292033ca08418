"""Pretraining of the nano base: phrase grounding on rendered scenes, then imitation of demonstrations.

May import `evaluation` and what that may import; does not know the federation. Start reading with `pretrain`.
"""
