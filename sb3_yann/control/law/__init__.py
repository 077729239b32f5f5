"""Piecewise affine laws and the search for a region."""
