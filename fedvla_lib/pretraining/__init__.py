"""How the nano base was made: rendered scenes teach it what words mean, then demonstrations teach it to act.

May import `evaluation` and what that may import; nothing of the federation. Start reading with `pretrain`.
"""
