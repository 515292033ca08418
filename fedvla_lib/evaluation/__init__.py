"""How good a policy is: error on held-out frames, success in closed loop, intervals, paired tests, videos.

May import `policy`, `data` and `robot`; Matplotlib in `figures` alone. Start reading with `measure`, which measures one
model once, then `statistics`.
"""
