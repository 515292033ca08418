"""What the book compares: methods, grids of them over partitions and seeds, their tables, a search.

May import every room but `cli`. Start reading with `methods`, then `plan` for the file that describes a grid.
"""
