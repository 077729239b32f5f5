"""The critical regions of active sets, many at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control.explicit.budget import (
    OF_REGION,
    BudgetTimer,
    effort_of_conditions,
    effort_of_lp,
    effort_of_qp,
)
from sb3_yann.control.explicit.kkt import equations
from sb3_yann.control.explicit.parametric_qp import ParametricQP, as_bits, batches, row_units
from sb3_yann.control.explicit.steep import SteepQP
from sb3_yann.control.polyhedra import (
    bounded_region,
    equal_rows,
    farthest_point,
    largest_ball,
)

Indices = NDArray[np.intp]
Rows = tuple[Array, Array]  # half-spaces A x <= b

# Regions that hold no ball of this radius, in half-widths of the box, are left out.
THINNEST = 1e-9
# Facets with nothing feasible beyond; and facets that several constraints share.
OUTER, SHARED = -1, -2
# Linear programs of more effort than this, in seconds, are solved by what can be interrupted.
LONG = 0.1
# Constraints whose part across those of an active set is smaller, relative to all, depend on them.
DEPENDENT = 1e-9


@dataclass(frozen=True, eq=False)
class Found:
    """A critical region.

    Attributes
    ----------
    active : int
        Its active set.
    law : ndarray, shape (v, n + 1)
        ``U = law [theta; 1]``.
    A, b : ndarray, shapes (q, n) and (q,)
        Its half-spaces.
    labels : list of int
        The constraint of each row, or OUTER or SHARED.
    inside : ndarray, shape (n,)
        A point well inside.
    beyond : dict
        The active sets across the rows of constraints that depend on the active ones.
    """

    active: int
    law: Array
    A: Array
    b: Array
    labels: list[int]
    inside: Array
    beyond: dict[int, tuple[int, ...]]

    def across(self, row: int) -> tuple[int, ...]:
        """Return the active sets that share a facet if nothing degenerates."""
        label = self.labels[row]
        return self.beyond.get(label, (self.active ^ (1 << label),)) if label >= 0 else ()


def members_of(active: int) -> list[int]:
    """Return a set of constraints that is a whole number as the list of its members."""
    return [k for k in range(active.bit_length()) if active >> k & 1]


@dataclass(frozen=True, eq=False)
class _Factors:
    """QR factors of some active sets of one size: ``N[index]' = Q R``.

    ``inverse`` and ``right`` are those of R and R', ``NQ`` is N Q, and ``depends`` tells which
    constraints the active ones make up.
    """

    index: Indices
    Q: Array
    inverse: Array
    right: Array
    NQ: Array
    depends: NDArray[np.bool_]


class Conditions:
    """The Karush-Kuhn-Tucker conditions of a program as functions of theta, for many active sets.

    With ``H = LL'`` and ``z = L'U`` the program is to find the shortest ``z + Y [theta; 1]`` with
    ``N z <= w + S theta``: the active rows are then all that a region needs to factor.
    """

    def __init__(self, program: ParametricQP, timer: BudgetTimer) -> None:
        tick = timer.tick  # counts effort, and raises when that or the time is over
        self.tick = tick
        moving, n = np.flatnonzero(np.any(program.G, axis=1)), program.F.shape[1]
        self.outer_A, self.outer_b = program.theta_rows()
        joint = _joint(program, moving, self.outer_A, self.outer_b)
        tick(effort_of_lp(*joint[0].shape))
        inside, _ = largest_ball(*joint)
        # Points of the feasible set that span it.
        self.corners, self.middle = _corners(*joint, inside, n, timer), inside[-n:]
        self.kept = moving[_irredundant(*joint, inside, len(moving), timer)]
        tick(0.0)
        L = np.linalg.cholesky(program.H)
        self.back = np.linalg.inv(L).T
        self.Y = np.linalg.solve(L, np.column_stack([program.F, program.c]))
        self.N = program.G[self.kept] @ self.back
        self.length = np.linalg.norm(self.N, axis=1)
        # The slack that each constraint has where none is active.
        self.D = np.column_stack([program.S, program.w])[self.kept] + self.N @ self.Y
        v, rows = len(self.back), len(self.kept)
        # Where constraints that depend on each other are all tight over a region, several active
        # sets have its law. Those count that are right with each constraint moved out a little.
        self.apart = np.random.default_rng(0).uniform(0.5, 1.5, rows)
        # Active sets that depend on each other, or share their law with another one.
        self.degenerate: set[int] = set()
        self.units = row_units(self.N)
        self._shortest = (np.eye(v), np.zeros(v), self.N * self.units[:, None])
        # What is solved in place of all this where slacks are too costly for it.
        own = {each: getattr(program, each)[self.kept] for each in "GwS"}
        self.steep = replace(program, **own) if isinstance(program, SteepQP) else None
        self._options = (np.full(rows, -1e30), np.zeros(rows, dtype=np.intc))

    def active_at(self, theta: Array, apart: float = 0.0) -> int | None:
        """Return DAQP's working set at theta with constraints moved apart, None if infeasible."""
        if np.any(self.outer_A @ theta > self.outer_b + 1e-11):
            return None
        if len(self.kept) == 0:
            return 0
        self.tick(effort_of_qp(*self.N.shape))
        if self.steep is not None:
            moved = replace(self.steep, w=self.steep.w + apart * self.apart)
            U, found = (moved if apart else self.steep).solve_with_multipliers(theta)
            return None if U is None else as_bits(np.flatnonzero(found > 0))
        import daqp

        n = len(theta)
        upper = self.D[:, :n] @ theta + self.D[:, n] + apart * self.apart
        _, _, status, info = daqp.solve(
            *self._shortest, upper * self.units, *self._options, primal_tol=1e-11
        )
        if status != 1:
            return None
        multipliers = np.asarray(info["lam"])
        active = np.flatnonzero(multipliers > 1e-11 * max(1.0, multipliers.max()))
        return as_bits(active)

    def regions(self, wave: list[int]) -> Iterator[Found]:
        """Yield the regions with an interior among those of some active sets."""
        rows, v = self.N.shape
        width = v + self.outer_A.shape[1] + 1

        def numbers(size: int) -> float:
            return (rows + v) * (size + width)

        for size, members in batches((active.bit_count() for active in wave), numbers):
            if size <= v:
                self.tick(len(members) * effort_of_conditions(rows, v, size))
                yield from self._regions([wave[i] for i in members], size)

    def _regions(self, members: list[int], size: int) -> Iterator[Found]:
        factors, full = self._factored(members, size)
        self.degenerate.update(one for one, good in zip(members, full, strict=True) if not good)
        actives = [one for one, good in zip(members, full, strict=True) if good]
        laws, rows, noise = self._rows(factors)
        constant = np.linalg.norm(rows[:, :, :-1], axis=2) <= 1e-12 * noise
        ok = self._not_weak(factors, rows, noise, constant)
        ruled_out = ok & self._ruled_out(
            factors, constant & (np.abs(rows[..., -1]) <= 1e-10 * noise)
        )
        self.degenerate.update(actives[i] for i in np.flatnonzero(ruled_out))
        scale = np.linalg.norm(rows[:, :, :-1], axis=2)
        scale[constant] = 1.0
        A, b = -rows[:, :, :-1] / scale[:, :, None], rows[:, :, -1] / scale
        reach = np.sum(np.abs(A), axis=2)
        ok &= ~ruled_out & ~np.any((b < THINNEST - reach) & ~constant, axis=1)
        needed = (b < reach - 1e-12) & ~constant
        for i in np.flatnonzero(ok):
            label = np.flatnonzero(needed[i])
            bounds = len(label) + len(self.outer_b)
            self.tick(OF_REGION + bounds * effort_of_lp(bounds, A.shape[2]) / 2)
            one = self._region(actives[i], laws[i], A[i, label], b[i, label], label)
            if one is not None:
                one.beyond.update(self._exchanges(one, factors, i))
                one.labels[:] = [OUTER if one.beyond.get(k) == () else k for k in one.labels]
                yield one

    def _factored(self, members: list[int], size: int) -> tuple[_Factors, NDArray[np.bool_]]:
        """Return the QR factors of active sets of independent constraints, and which are that."""
        index = np.array([members_of(active) for active in members], dtype=int)
        index = index.reshape(len(members), size)
        Q, R = np.linalg.qr(np.swapaxes(self.N[index], 1, 2))
        steep = np.abs(np.diagonal(R, axis1=1, axis2=2))
        full = np.all(steep > DEPENDENT * self.length[index], axis=1)
        Q, R, index = Q[full], R[full], index[full]
        inverse, NQ = np.linalg.inv(R), self.N @ Q
        left = np.linalg.norm(self.N - NQ @ np.swapaxes(Q, 1, 2), axis=2)
        depends = left <= DEPENDENT * self.length
        depends[np.arange(len(index))[:, None], index] = False
        return _Factors(index, Q, inverse, np.swapaxes(inverse, 1, 2), NQ, depends), full

    def _rows(self, factors: _Factors) -> tuple[Array, Array, Array]:
        """Return laws; slacks, or multipliers of active rows, as [S w]; the size of their terms."""
        index, inverse, NQ = factors.index, factors.inverse, factors.NQ
        if self.steep is not None:
            return equations(self.steep, index)[:3]
        W = factors.right @ self.D[index]
        rows = self.D - NQ @ W
        width = np.linalg.norm(W, axis=(1, 2))[:, None]
        noise = np.linalg.norm(self.D, axis=1) + np.linalg.norm(NQ, axis=2) * width
        each = np.arange(len(index))[:, None]
        rows[each, index] = -inverse @ W
        noise[each, index] = np.linalg.norm(inverse, axis=2) * width
        return self.back @ (factors.Q @ W - self.Y), rows, noise

    def _not_weak(
        self, factors: _Factors, rows: Array, noise: Array, constant: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Tell which active sets violate nothing everywhere, and have no multiplier of zero.

        With a multiplier that is zero everywhere the region is that of a smaller active set.
        """
        each, index = np.arange(len(rows))[:, None], factors.index
        ok = ~np.any(constant & (rows[:, :, -1] < -1e-10 * noise), axis=1)
        weak = constant[each, index] & (rows[each, index, -1] <= 1e-10 * noise[each, index])
        return np.asarray(ok & ~np.any(weak, axis=1))

    def _ruled_out(self, factors: _Factors, tight: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Tell which active sets are wrong with constraints moved apart, where others are tight."""
        index = factors.index
        tight[np.arange(len(index))[:, None], index] = False
        if not np.any(tight):
            return np.zeros(len(index), dtype=bool)
        moved = np.squeeze(factors.NQ @ (factors.right @ self.apart[index][:, :, None]), axis=2)
        return np.asarray(np.any(tight & (self.apart - moved < 0), axis=1))

    def _exchanges(self, one: Found, factors: _Factors, i: int) -> dict[int, tuple[int, ...]]:
        """Return the active sets across constraints that the active ones make up.

        One of those with a positive factor leaves.
        """
        index = factors.index[i]
        added = [k for k in one.labels if k >= 0 and factors.depends[i, k]]
        if not added:
            return {}
        made_of = factors.NQ[i, added] @ factors.right[i] * self.length[index]
        leaves = made_of > DEPENDENT * self.length[added, None]
        return {
            k: tuple(one.active ^ (1 << k) ^ (1 << int(j)) for j in index[leave])
            for k, leave in zip(added, leaves, strict=True)
        }

    def _region(
        self,
        active: int,
        law: Array,
        A: Array,
        b: Array,
        label: Indices,
    ) -> Found | None:
        A, b = np.concatenate([A, self.outer_A]), np.concatenate([b, self.outer_b])
        inside, radius, rows, equal = bounded_region(A, b, THINNEST)
        if radius <= THINNEST:
            return None
        A, b = A[rows], b[rows]
        labels = [int(label[k]) if k < len(label) else OUTER for k in rows]
        if equal:
            same = equal_rows(A, b - A @ inside, radius)
            first = np.argmax(same, axis=1)
            keep = np.flatnonzero(first == np.arange(len(rows)))
            for k in keep:
                twins = [labels[twin] for twin in np.flatnonzero(same[k])]
                if len(twins) > 1:
                    labels[k] = OUTER if OUTER in twins else SHARED
            A, b, labels = A[keep], b[keep], [labels[k] for k in keep]
        return Found(active, law, A, b, labels, inside, {})


def _joint(program: ParametricQP, rows: Indices, outer_A: Array, outer_b: Array) -> Rows:
    """Return the half-spaces of the feasible pairs (U, theta), those of theta alone last."""
    v = program.G.shape[1]
    A = np.vstack([
        np.hstack([program.G[rows], -program.S[rows]]),
        np.hstack([np.zeros((len(outer_b), v)), outer_A]),
    ])  # fmt: skip
    return A, np.concatenate([program.w[rows], outer_b])


def _corners(A: Array, b: Array, inside: Array, n: int, timer: BudgetTimer) -> Array:
    """Return the theta of feasible pairs that are farthest along every axis (2 n, n)."""
    axes = np.zeros((2 * n, len(inside)))
    axes[:n, -n:], axes[n:, -n:] = np.eye(n), -np.eye(n)
    return np.array([_farthest(A, b, axis, inside, timer)[-n:] for axis in axes])


def _farthest(A: Array, b: Array, direction: Array, inside: Array, timer: BudgetTimer) -> Array:
    """Return the farthest point in a direction; a large program ends when the time is over."""
    effort = effort_of_lp(*A.shape)
    timer.tick(effort)
    seconds = timer.left() if effort > LONG else None
    found = farthest_point(A, b, direction, inside, seconds)
    timer.tick()
    return found


def _irredundant(A: Array, b: Array, inside: Array, count: int, timer: BudgetTimer) -> list[int]:
    """Return which of the first rows bound a polyhedron; of those that say the same, the first."""
    alive = np.ones(len(b), dtype=bool)
    for k in reversed(range(count)):
        relaxed = b.copy()
        relaxed[k] += 1.0
        farthest = _farthest(A[alive], relaxed[alive], A[k], inside, timer)
        alive[k] = A[k] @ farthest > b[k] + 1e-10
    return [int(k) for k in np.flatnonzero(alive[:count])]
