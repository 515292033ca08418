"""What the book compares: methods, grids of them over partitions and seeds, result tables.

May import every package but `cli`. Start reading with `methods`, then `experiment_file` for the grid.
"""
