"""How far the poles of a fitted model may lie from those of the plant."""

from __future__ import annotations

import numpy as np
from scipy import linalg

from sb3_yann._validation import Array
from sb3_yann.control.identification.least_squares import Regression

WIDE = 0.5  # half-width from which an interval says only that the pole is not known
NORMAL = 1.96  # standard deviations on either side that hold 95 %


def pole_errors(found: Regression, n: int) -> tuple[Array, Array]:
    """Return the poles (n,), largest first, and their standard errors, inf of repeated poles.

    To first order a pole moves by ``y' dA x / y'x`` with its left and right eigenvectors. States
    after the first n are inputs on their way: they move none of these poles.
    """
    values, left, right = linalg.eig(found.coefficients[:n, :n], left=True, right=True)
    rows = np.real(np.sum(left.conj() * (found.covariance[:n, :n] @ left), axis=0))
    columns = np.real(np.sum(right.conj() * (found.correlation[:n, :n] @ right), axis=0))
    overlap = np.abs(np.sum(left.conj() * right, axis=0))
    size = np.sqrt(np.maximum(rows * columns, 0.0))
    errors = np.where(overlap > 1e-9, size / np.maximum(overlap, 1e-9), np.inf)
    order = np.argsort(-np.abs(values), kind="stable")
    return values[order], errors[order]


def pole_note(found: Regression, n: int) -> str:
    """Return the 95 % intervals of the poles in words, one of each complex pair."""
    values, errors = pole_errors(found, n)
    words, open_ends = [], 0
    for value, error in zip(values, errors, strict=True):
        if value.imag < 0:
            continue
        width = NORMAL * error
        imaginary = f" ± {value.imag:.4g}i" if value.imag else ""
        known = f"{value.real:.4g}{imaginary} within {width:.2g}"
        words.append(known if width < WIDE else f"{value.real:.4g}{imaginary}, hardly known")
        open_ends += bool(abs(value) < 1 <= abs(value) + width)
    text = f"Poles with 95 % confidence, under process noise: {'; '.join(words)}."
    if open_ends:
        text += (
            f" {open_ends} that decay in the model may be unstable in the plant, as far as the log "
            "tells."
        )
    return text
