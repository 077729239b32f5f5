"""What pickled laws of version 0.1 hold: a tree that found regions, and that nothing reads."""


class SearchTree:
    """Takes the place of the tree when such a law is read."""
