"""Three engines that run the same Flower app: in this process, on Flower's simulation runtime, and as a deployment.

May import `federation` and what that may import, and Flower. Start reading with `inline`, then `simulation` and
`deployment`, which start Flower's programs through `superlink`.
"""
