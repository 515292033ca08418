"""Federated learning of robot policies, small enough to read: the library behind the book."""
