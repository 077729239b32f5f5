"""The multi-parametric quadratic program that a linear MPC is, and its optimality conditions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array, half_widths

ROW_NORM_TOL = 1e-7
"""Bounds that all inputs together move by less, in half-widths of the box of theta, are its own.

Where such a bound is active, the law is so steep that its own rounding shows.
"""
DEPENDENT = 1e-9
"""Constraints whose part across those of an active set is smaller, relative to all, depend on it.
"""
MILD = 1e8
"""Up to so many times the inputs' own cost a slack may cost for a dual method."""


@dataclass(frozen=True, eq=False)
class ParametricQP:
    """``min_U 1/2 U'HU + (F theta + c)'U`` with ``G U <= w + S theta``, for theta in a box.

    Attributes
    ----------
    H, F, c : ndarray, shapes (v, v), (v, n) and (v,)
        H is positive definite.
    G, w, S : ndarray, shapes (rows, v), (rows,) and (rows, n)
    theta_min, theta_max : ndarray, shape (n,)
    n_slacks : int, default 0
        How many of the last variables are slacks of soft constraints, and no inputs.
    n_input_rows : int, default 0
        How many of the first rows are bounds of one input each.
    feedback : ndarray, shape (m, n), or None
        The first input is ``U[:m] + feedback theta``; None is no such part.

    Examples
    --------
    >>> one = np.ones((1, 1))
    >>> ParametricQP(H=one, F=-one, c=[0], G=one, w=np.ones(1), S=0 * one, theta_min=-one[0],
    ...              theta_max=one[0]).solve(np.array([0.5]))
    array([0.5])
    """

    H: Array
    F: Array
    c: Array
    G: Array
    w: Array
    S: Array
    theta_min: Array
    theta_max: Array
    n_slacks: int = 0
    n_input_rows: int = 0
    feedback: Array | None = None

    def first_input(self, U: Array, theta: Array, m: int) -> Array:
        """Return the first input (m,) of a solution U (v,) at theta (n,)."""
        return U[:m] if self.feedback is None else np.asarray(U[:m] + self.feedback @ theta)

    def solve(self, theta: Array) -> Array | None:
        """Return the optimal U (v,) at one theta (n,) from DAQP, or None where none is feasible."""
        return self.solve_with_multipliers(theta)[0]

    def solve_with_multipliers(self, theta: Array) -> tuple[Array | None, Array]:
        """Return the optimal U (v,), or None, and the multipliers of all rows (rows,)."""
        import daqp

        H, G, fixed, lower, sense, units = self._daqp_arrays
        upper = (self.w + self.S @ theta) * units
        if fixed.size:  # bounds of theta alone
            if upper[fixed].min() < -1e-11:
                return None, np.zeros(upper.size)
            upper[fixed] = 1.0
        U, _, status, info = daqp.solve(
            H, self.F @ theta + self.c, G, upper, lower, sense, primal_tol=1e-11
        )
        return (np.asarray(U) if status == 1 else None), np.asarray(info["lam"]) * units

    @cached_property
    def _daqp_arrays(self) -> tuple[Array, Array, NDArray[np.intp], Array, NDArray[np.intc], Array]:
        """Return H, G, the rows without U, no lower bounds, no options, and the units of rows."""
        units = row_units(self.G)
        H = np.ascontiguousarray(self.H)
        G = np.ascontiguousarray(self.G * units[:, None])
        fixed = np.flatnonzero(~np.any(G, axis=1))
        return H, G, fixed, np.full(len(G), -1e30), np.zeros(len(G), dtype=np.intc), units

    def theta_rows(self) -> tuple[Array, Array]:
        """Return A and b of the bounds of theta alone, for a program whose box is the unit box."""
        eye = np.eye(self.F.shape[1])
        bound = ~np.any(self.G, axis=1) & np.any(self.S, axis=1)
        b = np.concatenate([np.ones(2 * len(eye)), self.w[bound]])
        return np.vstack([eye, -eye, -self.S[bound]]), b

    def without(self, entries: NDArray[np.intp]) -> ParametricQP:
        """Return the same program without entries of theta that nothing depends on."""
        own: dict[str, Any] = {
            name: np.delete(getattr(self, name), entries, axis=-1)
            for name in ("F", "S", "theta_min", "theta_max")
        }
        K = self.feedback
        return replace(self, **own, feedback=None if K is None else np.delete(K, entries, axis=1))

    def without_short_rows(self, u_size: Array) -> ParametricQP:
        """Return a program of unit rows where rows that U hardly moves bound theta alone.

        Those are tightened by what U can do to them, less than ROW_NORM_TOL: the law stays exact,
        and the feasible set is so much smaller. ``u_size`` (v,) is the largest size of each
        variable, infinite where it has none.
        """
        with np.errstate(invalid="ignore"):  # 0 times inf
            moved = np.nan_to_num(np.abs(self.G) * u_size, nan=0.0, posinf=np.inf).sum(axis=1)
        short = (moved < ROW_NORM_TOL) & np.any(self.G, axis=1) & np.any(self.S, axis=1)
        w = self.w - np.where(short, moved, 0.0)
        return replace(self, G=np.where(short[:, None], 0.0, self.G), w=w)

    def without_repeated_rows(self) -> ParametricQP:
        """Return the program in which of rows that are the same but for rounding one counts.

        Late states of a plant that has come to rest make such rows. Rows are of unit length.
        """
        same_row = 1e-9  # by how much entries of unit rows differ that rounding tells apart
        rows = np.hstack([self.G, self.S])
        direction = np.random.default_rng(0).normal(size=rows.shape[1])
        order = np.argsort(rows @ direction)
        # Along any direction equal rows are neighbors: few others are compared.
        close = np.diff(rows[order] @ direction) < same_row * np.abs(direction).sum()
        some = np.union1d(order[:-1][close], order[1:][close])
        kept = list[int]()
        repeated = list[int]()
        for i in some[np.argsort(self.w[some], kind="stable")].tolist():
            near = kept and np.abs(rows[kept] - rows[i]).max(axis=1).min() < same_row
            (repeated if near else kept).append(i)
        none = np.isin(np.arange(len(rows)), repeated)
        G, S = (np.where(none[:, None], 0.0, each) for each in (self.G, self.S))
        return replace(self, G=G, S=S, w=np.where(none, 1.0, self.w)) if repeated else self

    def scaled(self, u_min: Array, u_max: Array, center: Array) -> tuple[ParametricQP, Array]:
        """Return the program in half-widths, of unit rows, and those of U (v,), 1 for slacks.

        Inputs have bounds (m,), theta counts from a center (n,). It knows no ``feedback``: that is
        of the units of the plant.
        """
        half = half_widths(self.theta_min, self.theta_max)
        steps = (len(self.c) - self.n_slacks) // len(u_min)
        reach = np.append(np.tile(half_widths(u_min, u_max), steps), np.ones(self.n_slacks))
        size = np.mean(np.diag(self.H) * reach**2)
        G = self.G * reach
        S = self.S * half
        length = row_norms(np.hstack([G, S]))
        program = replace(
            self,
            H=self.H * np.outer(reach, reach) / size,
            F=self.F * np.outer(reach, half) / size,
            c=(self.c + self.F @ center) * reach / size,
            G=G / length[:, None],
            w=(self.w + self.S @ center) / length,
            S=S / length[:, None],
            theta_min=(self.theta_min - center) / half,
            theta_max=(self.theta_max - center) / half,
            feedback=None,
        )
        return program, reach


def moderated(program: ParametricQP) -> ParametricQP:
    """Return a program in units of its input range and its box, with slacks of a bounded cost.

    In a dual method a slack is what is left when large numbers cancel: its digits are those of
    float64 less those of the penalty. The linear part, which makes the penalty exact, and the
    quadratic one are `MILD` times the inputs' own cost at most, with slacks in units of the largest
    that each may be. Several slacks are compared with each other as well, where not all bounds can
    hold: each may cost so many times the next cheaper one, and both parts keep their ratio.
    """
    ratio, largest = slack_costs(program)
    if np.all(ratio <= MILD):
        return program
    inputs = len(program.c) - program.n_slacks
    unit = np.mean(np.diag(program.H)[:inputs])
    H = program.H.copy()
    c = program.c.copy()
    G = program.G.copy()
    quadratic = np.diag(H)[inputs:] * largest**2 / unit
    linear = c[inputs:] * largest / unit
    if program.n_slacks == 1:
        quadratic = np.minimum(quadratic, MILD)
        linear = np.minimum(linear, MILD)
    else:
        order = np.argsort(linear)
        steps = np.diff(np.log(linear[order]), prepend=0.0)
        share = np.exp(np.cumsum(np.minimum(steps, np.log(MILD)))) / linear[order]
        quadratic[order] *= share
        linear[order] *= share
    H[inputs:, inputs:] = unit * np.diag(quadratic)
    c[inputs:] = unit * linear
    G[:, inputs:] *= largest
    length = row_norms(np.hstack([G, program.S]))
    S = program.S / length[:, None]
    return replace(program, H=H, c=c, G=G / length[:, None], S=S, w=program.w / length)


def slack_costs(program: ParametricQP) -> tuple[Array, Array]:
    """Return how many times the inputs' own cost each slack may cost, and the largest slacks.

    Both costs are compared where they are largest in theta's box: a slack where its bound is
    violated by all that it can be. The program comes in units of its input range and its box.
    """
    inputs = len(program.c) - program.n_slacks
    sizes = np.diag(program.H)
    extent = np.abs(program.S).sum(axis=1) + np.abs(program.G[:, :inputs]).sum(axis=1)
    own = np.abs(program.G[:, inputs:])
    violations = np.divide(extent[:, None], own, out=np.zeros_like(own), where=own > 0)
    largest = np.max(violations, axis=0, initial=0.0)
    largest[largest == 0] = 1.0
    return sizes[inputs:] * largest**2 / np.mean(sizes[:inputs]), largest


def slacks_made_cheap(program: ParametricQP) -> Array:
    """Return how many times as far as inputs move it each bound that `moderated` makes cheap gives.

    Where a violation that the inputs can mend still costs a thousand times what they do, as it does
    in all but the widest boxes, the law is the same: others are 0.
    """
    inputs = len(program.c) - program.n_slacks
    ratio, largest = slack_costs(program)
    linear = program.c[inputs:] * largest / np.mean(np.diag(program.H)[:inputs])
    own = np.abs(program.G[:, inputs:])
    moved = np.abs(program.G[:, :inputs]).sum(axis=1)[:, None]
    moved = np.divide(moved, own, out=np.zeros_like(own), where=own > 0).max(axis=0, initial=0.0)
    times = largest / np.maximum(moved, 1e-300)
    left = np.minimum(linear, MILD) / times + MILD / times**2
    return np.where((ratio > MILD) & (moved > 0) & (left < 1e3), times, 0.0)


@dataclass(frozen=True, eq=False)
class Optimality:
    """What the Karush-Kuhn-Tucker (KKT) conditions say of one active set.

    ``U = law [theta; 1]``, law (v, n + 1). Constraints and multipliers hold where
    ``rows[:, :n] theta <= rows[:, n]``, of unit length; those without theta are constants.
    ``labels`` are the constraint of each row. ``factors`` (rows, active) are each constraint's part
    along the active ones, all of unit length in U, and ``depends`` (rows,) says whether one that
    is not active has no other part.
    """

    active: tuple[int, ...]
    law: Array
    rows: Array
    labels: NDArray[np.intp]
    factors: Array
    depends: NDArray[np.bool_]

    def across(self, row: int) -> tuple[int, ...]:
        """Return the active sets beyond a row, as whole numbers: an empty tuple is a proof of none.

        A constraint that becomes active and depends on the others takes the place of one that it
        contains with a positive factor. If there is no such one, it contradicts them (Farkas).
        """
        flipped = as_bits(self.active) ^ (1 << int(self.labels[row]))
        if not self.depends[row]:
            return (flipped,)
        leaves = np.flatnonzero(self.factors[row] > DEPENDENT)
        return tuple(flipped ^ (1 << self.active[each]) for each in leaves)


def optimality(program: ParametricQP, members: Sequence[tuple[int, ...]]) -> list[Optimality]:
    """Return the KKT conditions of active sets of one size, from LU factors of the KKT matrices.

    Those that hold in all of the unit box are left out. LinAlgError of numpy where the constraints
    of an active set depend on each other.
    """
    n = program.F.shape[1]
    active = np.array(members, dtype=int).reshape(len(members), len(members[0]))
    v = len(program.c)
    count, size = active.shape
    # In unit length, however little U a constraint holds.
    length = row_norms(program.G)
    G = program.G / length[:, None]
    limit = np.column_stack([program.S, program.w]) / length[:, None]
    K = np.zeros((count, v + size, v + size))
    K[:, :v, :v] = program.H
    K[:, v:, :v] = G[active]
    K[:, :v, v:] = np.swapaxes(G[active], 1, 2)
    right = np.zeros((count, v + size, n + 1 + len(G)))
    right[:, :v, : n + 1] = -np.column_stack([program.F, program.c])
    right[:, v:, : n + 1] = limit[active]
    right[:, :v, n + 1 :] = G.T
    both = np.linalg.solve(K, right)
    # One more step: rows that hold little U have multipliers of many magnitudes.
    both += np.linalg.solve(K, right - K @ both)
    laws = both[:, :v, : n + 1]
    multipliers = both[:, v:, : n + 1]
    factors = np.swapaxes(both[:, v:, n + 1 :], 1, 2)
    depends = np.linalg.norm(G - factors @ G[active], axis=2) <= DEPENDENT
    rows = limit - G @ laws
    noise = np.linalg.norm(limit, axis=1) + np.linalg.norm(laws, axis=(1, 2))[:, None]
    each = np.arange(count)[:, None]
    depends[each, active] = False
    rows[each, active] = multipliers
    noise[each, active] = np.abs(multipliers).max(axis=(1, 2), initial=0.0)[:, None]
    # [S w] of 0 <= S theta + w as [A b] of A theta <= b. A gradient is rounding if it is smaller
    # than 1e-11 of what it is a sum of.
    length = np.linalg.norm(rows[:, :, :n], axis=2)
    constant = length <= 1e-11 * noise
    length[constant] = np.maximum(noise[constant], 1e-300)
    rows = np.concatenate([-rows[:, :, :n], rows[:, :, n:]], axis=2) / length[:, :, None]
    rows[constant, :n] = 0.0
    binding = rows[:, :, n] < np.abs(rows[:, :, :n]).sum(axis=2)
    return [
        Optimality(
            active=members[i],
            law=laws[i],
            rows=rows[i, held],
            labels=np.flatnonzero(held),
            factors=factors[i, held],
            depends=depends[i, held],
        )
        for i, held in enumerate(binding)
    ]


def as_bits(active_set: Iterable[int]) -> int:
    """Return a set of constraints as a whole number, with bit k for constraint k."""
    return sum(1 << int(k) for k in active_set)


def members_of(active: int) -> tuple[int, ...]:
    """Return the members of a set of constraints that is a whole number."""
    return tuple(k for k in range(active.bit_length()) if active >> k & 1)


def batches(
    sizes: Iterable[int], numbers: Callable[[int], float]
) -> Iterator[tuple[int, list[int]]]:
    """Yield each size, ascending, with the indices that have it, at most 256 at a time.

    ``numbers`` is how many numbers one of a size needs: a batch holds 4 million, or 32 MB.
    """
    indices: dict[int, list[int]] = {}
    for i, size in enumerate(sizes):
        indices.setdefault(size, []).append(i)
    for size, members in sorted(indices.items()):
        most = int(np.clip(4e6 / numbers(size), 1, 256))
        for start in range(0, len(members), most):
            yield size, members[start : start + most]


def row_units(G: Array) -> Array:
    """Return factors (rows,) that give rows a length of about 1, without rounding.

    DAQP takes a row that is shorter than about 1e-6 for one that does not bind.
    """
    return np.asarray(2.0 ** -np.round(np.log2(row_norms(G))))


def row_norms(rows: Array) -> Array:
    """Return the lengths of rows, 1 for zero rows."""
    length = np.linalg.norm(rows, axis=1)
    length[length == 0] = 1.0
    return np.asarray(length)
