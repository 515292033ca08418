"""The command line `fedvla` and its doctor.

May import everything, but heavy packages only inside a command, so that help answers at once. Start reading with
`parser`.
"""
