"""Three ways to run the one Flower app: in this process, on Flower's simulation runtime, and as a deployment.

May import `federation` and what that may import, and Flower. Start reading with `inline`, then `simulation` and
`deployment`; both of these start Flower's own programs through `superlink`.
"""
