"""Compiled loops of a twin."""
