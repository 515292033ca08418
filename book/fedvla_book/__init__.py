"""Code of the book only: figures, tables, exercise checks, video player, chapter costs, checklists.

May import the library; the library does not import it. Start reading with `plots`.
"""
