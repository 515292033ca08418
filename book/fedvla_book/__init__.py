"""What only the book needs: figures, exercise checks, the video player, the cost of a chapter, checklists.

May import the library, which does not know it. Start reading with `plots`.
"""
