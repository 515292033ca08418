"""One Flower app: what a client does in a round, what the server does, and what travels between them.

May import `evaluation` and what that may import, and Flower. Does not know on which engine it runs. Start reading with
`server_app` and `client_app`; how updates are combined is in `strategies`.
"""
