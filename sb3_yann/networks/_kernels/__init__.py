"""Compiled loops of the networks, which take arrays."""
