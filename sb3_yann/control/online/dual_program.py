"""A condensed program in its dual form, in which each point costs no factorization of its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from sb3_yann._validation import Array, half_widths
from sb3_yann.control.explicit.parametric_qp import ParametricQP
from sb3_yann.control.explicit.steep import SteepQP, solvable

if TYPE_CHECKING:
    from sb3_yann._numba import Integers

SOFT = 1e6
"""Cost of the square of a violation, in units of the curvature of the cost, where none is free."""
ROUGH = 1e-6
"""How exact a softened program must be solved, relative to the largest distance to a constraint."""
LEAST_SOFT = 1e-8
"""So much at least is added to the unit diagonal where a constraint is softened."""


@dataclass(frozen=True, eq=False)
class Answers:
    """What comes of rows of theta.

    Attributes
    ----------
    multipliers, active : ndarray, shape (batch, most)
    sizes, status : ndarray of int, shape (batch,)
        How many constraints are active, and a status of `_kernels`.
    """

    multipliers: Array
    active: Integers
    sizes: Integers
    status: Integers


@dataclass(frozen=True, eq=False)
class DualProgram:
    """The slacks ``s = d0 + D' theta + gram lam`` and inputs ``u = k0 + K theta - E' lam``.

    Attributes
    ----------
    D, d0, gram : ndarray, shapes (n, rows), (rows,) and (rows, rows)
        Of the constraints that the inputs can meet, in units in which ``gram`` has ones.
    E, K, k0 : ndarray, shapes (rows, m), (m, n) and (m,)
        In the units of the plant.
    softness : ndarray, shape (rows,)
        What is added to the diagonal of ``gram`` where a constraint is to give way.
    fixed : pair of ndarray, shapes (k, n) and (k,)
        ``S theta + w >= 0``: what no input can change.
    bounds : ndarray, shape (2, m)
        Of the inputs.
    rows : ndarray of int
        Where these constraints lie in the program.
    n_variables : int
    """

    D: Array
    d0: Array
    gram: Array
    E: Array
    K: Array
    k0: Array
    softness: Array
    fixed: tuple[Array, Array]
    bounds: Array
    rows: Integers
    n_variables: int

    @classmethod
    def of(cls, program: ParametricQP, u_min: Array, u_max: Array) -> DualProgram:
        """Return the dual form of a program whose first variables are the inputs (m,)."""
        scaled, reach = scaled_program(program, u_min, u_max)
        half = half_widths(program.theta_min, program.theta_max)
        if isinstance(scaled, SteepQP):
            scaled = scaled.mild
        # Rows are of unit length in these units; theta itself comes in those of the plant.
        scaled = replace(scaled, F=scaled.F / half, S=scaled.S / half)
        m, unit = len(u_min), reach[: len(u_min), None]
        G, factor = scaled.G, linalg.cho_factor(scaled.H)
        by_theta, by_one, by_row = (
            linalg.cho_solve(factor, each) for each in (scaled.F, scaled.c[:, None], G.T)
        )
        size = np.sqrt(np.maximum(np.sum(G * by_row.T, axis=1), 0.0))
        moved = size > 1e-12 * max(1.0, size.max(initial=0.0))
        own = size[moved, None]
        D = (scaled.S + G @ by_theta)[moved] / own
        d0 = (scaled.w + (G @ by_one)[:, 0])[moved] / own[:, 0]
        gram = (G @ by_row)[np.ix_(moved, moved)] / (own * own.T)
        softness = np.where(_hard(program)[moved], 0.0, _softness(own[:, 0]))
        np.fill_diagonal(gram, 1.0)
        E, K = (unit * by_row[:m, moved] / own[:, 0]).T, -unit * by_theta[:m]
        D, gram, E, K = map(np.ascontiguousarray, (D.T, gram, E, K))
        if program.feedback is not None:
            K = K + program.feedback
        fixed = scaled.S[~moved], scaled.w[~moved]
        k0, bounds = -reach[:m] * by_one[:m, 0], np.stack([u_min, u_max])
        return cls(
            D, d0, gram, E, K, k0, softness, fixed, bounds, np.flatnonzero(moved), len(reach)
        )

    def solve(self, theta: Array, soft: bool = False) -> Answers:
        """Return what comes of rows (batch, n); where ``soft``, constraints give way."""
        from sb3_yann.control.online._kernels import solve_batch

        batch, rows = len(theta), len(self.d0)
        most = max(1, rows if soft else min(rows, self.n_variables))
        extra = self.softness if soft else np.zeros(rows)
        found = Answers(
            np.zeros((batch, most)),
            np.zeros((batch, most), np.int64),
            np.zeros(batch, np.int64),
            np.zeros(batch, np.int64),
        )
        solve_batch(theta, self.D, self.d0, self.gram, extra, most, *vars(found).values())
        return found

    def inputs(self, theta: Array, found: Answers) -> Array:
        """Return the inputs (batch, m), between their bounds."""
        from sb3_yann.control.online._kernels import inputs_of_batch

        u = np.empty((len(theta), len(self.k0)))
        lam = found.multipliers, found.active, found.sizes
        inputs_of_batch(theta, self.K, self.k0, self.E, *lam, self.bounds, u)
        return u

    def soft_inputs(self, theta: Array, found: Answers) -> Array:
        """Return the inputs (batch, m) of softened programs: saturated where none is solved.

        Far from the box multipliers are so large that the certificate's tolerances are their
        rounding. There the conditions must hold to ROUGH of the largest distance.
        """
        from sb3_yann.control.online._kernels import SOLVED

        u = self.inputs(theta, found)
        for i in np.flatnonzero(found.status != SOLVED):
            active, lam = found.active[i, : found.sizes[i]], np.zeros(len(self.d0))
            lam[active] = found.multipliers[i, : found.sizes[i]]
            with np.errstate(over="ignore", invalid="ignore"):
                d = self.d0 + theta[i] @ self.D
                slack = d + self.gram @ lam + self.softness * lam
                most = ROUGH * (1 + np.abs(d).max())
                held = slack.min() >= -most and np.abs(slack[active]).max(initial=0.0) <= most
                law = self.k0 + self.K @ theta[i]
            if not held:
                u[i] = np.clip(np.nan_to_num(law, nan=0.0), *self.bounds)
        return u

    def meets_fixed(self, theta: Array) -> NDArray[np.bool_]:
        """Tell of each row whether it keeps what no input can change."""
        S, w = self.fixed
        return np.asarray(np.all(theta @ S.T + w >= -1e-11, axis=1))

    def gain(self, active: Integers, soft: bool = False) -> Array:
        """Return the derivative (m, n) of the inputs by theta for an active set."""
        inner = self.gram[np.ix_(active, active)]
        if soft:
            inner = inner + np.diag(self.softness[active])
        return np.asarray(self.K + self.E[active].T @ linalg.solve(inner, self.D[:, active].T))


def scaled_program(program: ParametricQP, u_min: Array, u_max: Array) -> tuple[ParametricQP, Array]:
    """Return the program in units of the input range and theta's box, and those of U (v,)."""
    steps = (len(program.c) - program.n_slacks) // len(u_min)
    reach = np.tile(half_widths(u_min, u_max), steps)
    reach = np.concatenate([reach, np.ones(program.n_slacks)])
    half = half_widths(program.theta_min, program.theta_max)
    return solvable(program.scaled(np.zeros(len(half)), half, reach)), reach


def _hard(program: ParametricQP) -> NDArray[np.bool_]:
    """Tell which rows never give way: bounds of one input, and what has a slack already."""
    inputs = len(program.c) - program.n_slacks
    alone = (np.count_nonzero(program.G, axis=1) == 1) & ~np.any(program.S, axis=1)
    alone |= np.arange(len(alone)) < program.n_input_rows
    return np.asarray(alone | np.any(program.G[:, inputs:], axis=1))


def _softness(size: Array) -> Array:
    return np.maximum(1 / (SOFT * size**2), LEAST_SOFT)
