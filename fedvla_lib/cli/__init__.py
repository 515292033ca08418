"""The command line `fedvla`.

May import everything, but heavy packages only inside commands, so that help appears at once. Start reading with
`parser`.
"""
