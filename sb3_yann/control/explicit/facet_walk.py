"""A walk over the critical regions of a quadratic program, from facet to facet."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control.explicit.budget import BudgetTimer
from sb3_yann.control.explicit.parametric_qp import ParametricQP, as_bits, batches, row_units
from sb3_yann.control.polyhedra import (
    Region,
    equal_rows,
    farthest_point,
    farthest_points,
    largest_ball,
    region,
)

Indices = NDArray[np.intp]
Rows = tuple[Array, Array]  # half-spaces A x <= b

# Regions that hold no ball of this radius, in half-widths of the box, are left out.
THINNEST = 1e-9
# Facets with nothing feasible beyond; and facets that several constraints share.
OUTER, SHARED = -1, -2
# Constraints whose part across those of an active set is smaller, relative to all, depend on them.
DEPENDENT = 1e-9


@dataclass(frozen=True, eq=False)
class _Found:
    """A critical region, its law ``U = law [theta; 1]`` and the constraint of each row.

    ``beyond`` has the active sets that lie across the rows of constraints that depend on the active
    ones.
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


def walk(program: ParametricQP, timer: BudgetTimer) -> list[Region]:
    """Return the critical regions of a program with unit rows whose box is the unit box.

    Across a facet where constraint k becomes active, or inactive, lies the region of the active
    set with k added, or removed. If k depends on the active constraints, it takes the place of one
    of those that it contains with a positive factor; if there is none, nothing feasible lies there
    (Farkas' lemma). Where these sets have no region, a QP just across the middle of the facet tells
    what lies there. Last, QPs at random points look for what the walk has not seen. Sets of
    constraints are whole numbers, with bit k for k.
    """
    found = _Walk(program, timer)
    found.explore(found.seeds(20))
    for _ in range(10):
        missed = set(found.seeds(20 * program.F.shape[1])) - found.seen
        if not missed:
            break
        found.explore(missed)
    return found.regions()


class _Walk:
    def __init__(self, program: ParametricQP, timer: BudgetTimer) -> None:
        self.program, self.timer = program, timer
        self.conditions = Conditions(program)
        self.found: dict[int, _Found] = {}
        self.seen: set[int] = set()
        self.random = np.random.default_rng(0)

    def regions(self) -> list[Region]:
        kept = self.conditions.kept
        rows = [tuple(kept[_members(active)].tolist()) for active in self.found]
        return [
            Region(active, one.law[:, :-1], one.law[:, -1], one.A, one.b, one.inside)
            for active, one in zip(rows, self.found.values(), strict=True)
        ]

    def seeds(self, count: int) -> Iterator[int]:
        """Yield the active sets where no region is known, at random points of the feasible set."""
        corners, middle = self.conditions.corners, self.conditions.middle
        weights = self.random.dirichlet(np.ones(len(corners)), count)
        points = np.vstack([0 * middle, middle, 0.9 * weights @ corners + 0.1 * middle])
        for point in points[~self._known(points)]:
            active = self._active_at(point)
            if active is not None:
                yield active

    def _known(self, points: Array) -> NDArray[np.bool_]:
        """Tell which points a region holds that was found."""
        known = np.zeros(len(points), dtype=bool)
        for one in self.found.values():
            known |= np.all(points @ one.A.T <= one.b, axis=1)
        return known

    def _active_at(self, point: Array) -> int | None:
        """Return the active set at a point, if there are several one that is not ruled out."""
        active = self.conditions.active_at(point)
        if active in self.seen and active not in self.found:
            return self.conditions.active_at(point, apart=1e-9)
        return active

    def explore(self, wave: Iterable[int]) -> None:
        """Add all regions that are connected with those of some active sets."""
        ahead = sorted(set(wave) - self.seen)
        facets: list[tuple[_Found, int]] = []
        while ahead:
            self.seen.update(ahead)
            following = set()
            for one in self.conditions.regions(ahead):
                self.timer.count()
                self.found[one.active] = one
                facets += [(one, row) for row in range(len(one.labels))]
                following.update(*map(one.across, range(len(one.labels))))
            ahead = sorted(following - self.seen)
            if not ahead:  # what the flips have left open
                left = [(pair, self._across(*pair)) for pair in facets if self._open(*pair)]
                ahead = sorted({active for _, active in left if active is not None})
                facets = [pair for pair, active in left if active is not None]

    def _open(self, one: _Found, row: int) -> bool:
        """Tell whether it is not known what lies across a facet."""
        label, across = one.labels[row], one.across(row)
        known = any(active in self.found for active in across)
        return label != OUTER and (not known or not self.conditions.degenerate.isdisjoint(across))

    def _across(self, one: _Found, row: int) -> int | None:
        """Return the active set across a facet, None if none is new or feasible there."""
        self.timer.tick()
        middle, distance = largest_ball(one.A, one.b, row)
        if distance <= THINNEST:  # the row only touches the region
            return None
        # The shortest step that gives an answer: a longer one may cross a thin region.
        for step in (1e-7, 1e-6, 1e-5):
            point = middle + min(step, distance) * one.A[row]
            active = self._active_at(point)
            if active is None:
                return None
            if active not in self.seen:
                return active
            other = self.found.get(active, one)
            slacks = (np.min(other.b - other.A @ each) for each in (middle, point))
            if other is not one and min(slacks) >= -1e-9:
                return None
        return None


def _members(active: int) -> list[int]:
    return [k for k in range(active.bit_length()) if active >> k & 1]


class Conditions:
    """The Karush-Kuhn-Tucker conditions of a program as functions of theta, for many active sets.

    With ``H = LL'`` and ``z = L'U`` the program is to find the shortest ``z + Y [theta; 1]`` with
    ``N z <= w + S theta``: the active rows are then all that a region needs to factor.
    """

    def __init__(self, program: ParametricQP) -> None:
        moving, n = np.flatnonzero(np.any(program.G, axis=1)), program.F.shape[1]
        self.outer_A, self.outer_b = program.theta_rows()
        joint = _joint(program, moving, self.outer_A, self.outer_b)
        inside, _ = largest_ball(*joint)
        # Points of the feasible set that span it.
        self.corners, self.middle = _corners(*joint, inside, n), inside[-n:]
        self.kept = moving[_irredundant(*joint, inside, len(moving))]
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
        self._options = (np.full(rows, -1e30), np.zeros(rows, dtype=np.intc))

    def active_at(self, theta: Array, apart: float = 0.0) -> int | None:
        """Return DAQP's working set at theta with constraints moved apart, None if infeasible."""
        if np.any(self.outer_A @ theta > self.outer_b + 1e-11):
            return None
        if len(self.kept) == 0:
            return 0
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

    def regions(self, wave: list[int]) -> Iterator[_Found]:
        """Yield the regions with an interior among those of some active sets."""
        for size, members in batches(active.bit_count() for active in wave):
            if size <= self.N.shape[1]:
                yield from self._regions([wave[i] for i in members], size)

    def _regions(self, members: list[int], size: int) -> Iterator[_Found]:
        index = np.array([_members(active) for active in members], dtype=int)
        index = index.reshape(len(members), size)
        Q, R = np.linalg.qr(np.swapaxes(self.N[index], 1, 2))
        steep = np.abs(np.diagonal(R, axis1=1, axis2=2))
        full = np.all(steep > DEPENDENT * self.length[index], axis=1)
        Q, R, index = Q[full], R[full], index[full]
        inverse = np.linalg.inv(R)
        right = np.swapaxes(inverse, 1, 2)
        W, NQ = right @ self.D[index], self.N @ Q
        left = np.linalg.norm(self.N - NQ @ np.swapaxes(Q, 1, 2), axis=2)
        depends = left <= DEPENDENT * self.length
        depends[np.arange(len(index))[:, None], index] = False
        rows = self.D - NQ @ W
        width = np.linalg.norm(W, axis=(1, 2))[:, None]
        noise = np.linalg.norm(self.D, axis=1) + np.linalg.norm(NQ, axis=2) * width
        each = np.arange(len(index))[:, None]
        rows[each, index] = -inverse @ W
        noise[each, index] = np.linalg.norm(inverse, axis=2) * width
        laws = self.back @ (Q @ W - self.Y)
        constant = np.linalg.norm(rows[:, :, :-1], axis=2) <= 1e-12 * noise
        # A multiplier that is zero everywhere: the region is that of a smaller active set.
        ok = ~np.any(constant & (rows[:, :, -1] < -1e-10 * noise), axis=1)
        weak = constant[each, index] & (rows[each, index, -1] <= 1e-10 * noise[each, index])
        ok &= ~np.any(weak, axis=1)
        regular = ok.copy()
        tight = constant & (np.abs(rows[:, :, -1]) <= 1e-10 * noise)
        tight[each, index] = False
        if np.any(tight):
            moved = self.apart - np.squeeze(NQ @ (right @ self.apart[index][:, :, None]), axis=2)
            ok &= ~np.any(tight & (moved < 0), axis=1)
        actives = [active for active, good in zip(members, full, strict=True) if good]
        self.degenerate.update(active for active, good in zip(members, full) if not good)
        self.degenerate.update(actives[i] for i in np.flatnonzero(regular & ~ok))
        scale = np.linalg.norm(rows[:, :, :-1], axis=2)
        scale[constant] = 1.0
        A, b = -rows[:, :, :-1] / scale[:, :, None], rows[:, :, -1] / scale
        reach = np.sum(np.abs(A), axis=2)
        ok &= ~np.any((b < THINNEST - reach) & ~constant, axis=1)
        needed = (b < reach - 1e-12) & ~constant
        for i in np.flatnonzero(ok):
            label = np.flatnonzero(needed[i])
            one = self._region(actives[i], laws[i], A[i, label], b[i, label], label)
            if one is not None:
                swapped = [k for k in one.labels if k >= 0 and depends[i, k]]
                factors = NQ[i, swapped] @ right[i]
                one.beyond.update(self._exchanges(actives[i], index[i], swapped, factors))
                one.labels[:] = [OUTER if one.beyond.get(k) == () else k for k in one.labels]
                yield one

    def _exchanges(
        self, active: int, index: Indices, added: list[int], factors: Array
    ) -> dict[int, tuple[int, ...]]:
        """Return the active sets across constraints that the active ones make with these factors.

        One of those with a positive factor leaves.
        """
        leaves = factors * self.length[index] > DEPENDENT * self.length[added, None]
        return {
            k: tuple(active ^ (1 << k) ^ (1 << int(j)) for j in index[leave])
            for k, leave in zip(added, leaves, strict=True)
        }

    def _region(
        self,
        active: int,
        law: Array,
        A: Array,
        b: Array,
        label: Indices,
    ) -> _Found | None:
        A, b = np.concatenate([A, self.outer_A]), np.concatenate([b, self.outer_b])
        inside, radius, rows = region(A, b, THINNEST)
        if radius <= THINNEST:
            return None
        A, b = A[rows], b[rows]
        labels = [int(label[k]) if k < len(label) else OUTER for k in rows]
        same = equal_rows(A, b - A @ inside, radius)
        if np.count_nonzero(same) > len(rows):
            first = np.argmax(same, axis=1)
            keep = np.flatnonzero(first == np.arange(len(rows)))
            for k in keep:
                twins = [labels[twin] for twin in np.flatnonzero(same[k])]
                if len(twins) > 1:
                    labels[k] = OUTER if OUTER in twins else SHARED
            A, b, labels = A[keep], b[keep], [labels[k] for k in keep]
        return _Found(active, law, A, b, labels, inside, {})


def _joint(program: ParametricQP, rows: Indices, outer_A: Array, outer_b: Array) -> Rows:
    """Return the half-spaces of the feasible pairs (U, theta), those of theta alone last."""
    v = program.G.shape[1]
    A = np.vstack([
        np.hstack([program.G[rows], -program.S[rows]]),
        np.hstack([np.zeros((len(outer_b), v)), outer_A]),
    ])  # fmt: skip
    return A, np.concatenate([program.w[rows], outer_b])


def _corners(A: Array, b: Array, inside: Array, n: int) -> Array:
    """Return the theta of feasible pairs that are farthest along every axis (2 n, n)."""
    axes = np.zeros((2 * n, len(inside)))
    axes[:n, -n:], axes[n:, -n:] = np.eye(n), -np.eye(n)
    return farthest_points(A, b, inside, axes)[:, -n:]


def _irredundant(A: Array, b: Array, inside: Array, count: int) -> list[int]:
    """Return which of the first rows bound a polyhedron; of those that say the same, the first."""
    alive = np.ones(len(b), dtype=bool)
    for k in reversed(range(count)):
        relaxed = b.copy()
        relaxed[k] += 1.0
        farthest = farthest_point(A[alive], relaxed[alive], A[k], inside)
        alive[k] = A[k] @ farthest > b[k] + 1e-10
    return [int(k) for k in np.flatnonzero(alive[:count])]
