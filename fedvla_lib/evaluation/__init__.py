"""Policy evaluation: error on held-out frames, success in closed loop, confidence intervals, paired tests, videos.

May import `policy`, `data` and `robot`; Matplotlib in `figures` alone. Start reading with `measure`, which evaluates
a model, then `statistics`.
"""
