"""One Flower app: the client side, the server side and the messages between them.

May import `evaluation` and what that may import, and Flower. Does not know on which engine it runs. Start reading with
`server_app` and `client_app`; aggregation is in `strategies`.
"""
