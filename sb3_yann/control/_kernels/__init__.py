"""Compiled loops: linear programs over regions, the search for a region, the online program."""
