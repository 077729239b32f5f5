"""A walk over the critical regions of a quadratic program, from facet to facet."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control.explicit.budget import BudgetTimer
from sb3_yann.control.explicit.parametric_qp import ParametricQP, as_bits, batches
from sb3_yann.control.polyhedra import Region, farthest_point, largest_ball, region

Indices = NDArray[np.intp]

# Regions that hold no ball of this radius, in half-widths of the box, are left out.
THINNEST = 1e-9
# Facets of theta alone; and facets that several constraints share.
OUTER, SHARED = -1, -2


@dataclass(frozen=True, eq=False)
class _Found:
    """A critical region, its law ``U = law [theta; 1]`` and the constraint of each row."""

    active: int
    law: Array
    A: Array
    b: Array
    labels: list[int]
    inside: Array


def walk(program: ParametricQP, timer: BudgetTimer) -> list[Region]:
    """Return the critical regions of a program with unit rows whose box is the unit box.

    Across a facet where constraint k becomes active, or inactive, lies the region of the active
    set with k added, or removed. Where that set has no region, a QP just across the middle of the
    facet tells what lies there. Last, QPs at random points of the box look for what the walk has
    not seen. Sets of constraints are whole numbers, with bit k for k.
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

    def regions(self) -> list[Region]:
        kept = self.conditions.kept
        rows = [tuple(kept[_members(active)].tolist()) for active in self.found]
        return [
            Region(active, one.law[:, :-1], one.law[:, -1], one.A, one.b, one.inside)
            for active, one in zip(rows, self.found.values(), strict=True)
        ]

    def seeds(self, count: int) -> Iterator[int]:
        """Yield the active sets where no region is known: at the center and at random points."""
        n = self.program.F.shape[1]
        points = np.vstack([np.zeros(n), np.random.default_rng(0).uniform(-1, 1, (count, n))])
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
                following |= {one.active ^ (1 << label) for label in one.labels if label >= 0}
            ahead = sorted(following - self.seen)
            if not ahead:  # what the flips have left open
                left = [(pair, self._across(*pair)) for pair in facets if self._open(*pair)]
                ahead = sorted({active for _, active in left if active is not None})
                facets = [pair for pair, active in left if active is not None]

    def _open(self, one: _Found, row: int) -> bool:
        """Tell whether it is not known what lies across a facet."""
        label = one.labels[row]
        return label == SHARED or (label >= 0 and one.active ^ (1 << label) not in self.found)

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
        moving = np.flatnonzero(np.any(program.G, axis=1))
        self.outer_A, self.outer_b = program.theta_rows()
        self.kept = moving[_irredundant(program, moving, self.outer_A, self.outer_b)]
        L = np.linalg.cholesky(program.H)
        self.back = np.linalg.inv(L).T
        self.Y = np.linalg.solve(L, np.column_stack([program.F, program.c]))
        self.N = program.G[self.kept] @ self.back
        # The slack that each constraint has where none is active.
        self.D = np.column_stack([program.S, program.w])[self.kept] + self.N @ self.Y
        v, rows = len(self.back), len(self.kept)
        # Where constraints that depend on each other are all tight over a region, several active
        # sets have its law. Those count that are right with each constraint moved out a little.
        self.apart = np.random.default_rng(0).uniform(0.5, 1.5, rows)
        self._shortest = (np.eye(v), np.zeros(v), self.N)
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
        _, _, status, info = daqp.solve(*self._shortest, upper, *self._options, primal_tol=1e-11)
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
        lengths = np.linalg.norm(self.N, axis=1)[index]
        full = np.all(np.abs(np.diagonal(R, axis1=1, axis2=2)) > 1e-9 * lengths, axis=1)
        Q, R, index = Q[full], R[full], index[full]
        inverse = np.linalg.inv(R)
        right = np.swapaxes(inverse, 1, 2)
        W, NQ = right @ self.D[index], self.N @ Q
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
        tight = constant & (np.abs(rows[:, :, -1]) <= 1e-10 * noise)
        tight[each, index] = False
        if np.any(tight):
            moved = self.apart - np.squeeze(NQ @ (right @ self.apart[index][:, :, None]), axis=2)
            ok &= ~np.any(tight & (moved < 0), axis=1)
        scale = np.linalg.norm(rows[:, :, :-1], axis=2)
        scale[constant] = 1.0
        A, b = -rows[:, :, :-1] / scale[:, :, None], rows[:, :, -1] / scale
        reach = np.sum(np.abs(A), axis=2)
        ok &= ~np.any((b < THINNEST - reach) & ~constant, axis=1)
        needed = (b < reach - 1e-12) & ~constant
        actives = [active for active, good in zip(members, full, strict=True) if good]
        for i in np.flatnonzero(ok):
            label = np.flatnonzero(needed[i])
            one = self._region(actives[i], laws[i], A[i, label], b[i, label], label)
            if one is not None:
                yield one

    def _region(self, active: int, law: Array, A: Array, b: Array, label: Indices) -> _Found | None:
        A, b = np.concatenate([A, self.outer_A]), np.concatenate([b, self.outer_b])
        inside, radius, rows = region(A, b, THINNEST)
        if radius <= THINNEST:
            return None
        A, b = A[rows], b[rows]
        labels = [int(label[k]) if k < len(label) else OUTER for k in rows]
        scaled = np.column_stack([A, (b - A @ inside) / radius])
        same = np.abs(scaled[:, None] - scaled[None]).max(axis=2) < 1e-6
        if np.count_nonzero(same) > len(rows):
            first = np.argmax(same, axis=1)
            keep = np.flatnonzero(first == np.arange(len(rows)))
            for k in keep:
                twins = [labels[twin] for twin in np.flatnonzero(same[k])]
                if len(twins) > 1:
                    labels[k] = OUTER if OUTER in twins else SHARED
            A, b, labels = A[keep], b[keep], [labels[k] for k in keep]
        return _Found(active, law, A, b, labels, inside)


def _irredundant(program: ParametricQP, rows: Indices, outer_A: Array, outer_b: Array) -> list[int]:
    """Return which rows bound the pairs (U, theta); of those that say the same, the first."""
    v = program.G.shape[1]
    A = np.vstack([
        np.hstack([program.G[rows], -program.S[rows]]),
        np.hstack([np.zeros((len(outer_b), v)), outer_A]),
    ])  # fmt: skip
    b = np.concatenate([program.w[rows], outer_b])
    inside, _ = largest_ball(A, b)
    alive = np.ones(len(b), dtype=bool)
    for k in reversed(range(len(rows))):
        relaxed = b.copy()
        relaxed[k] += 1.0
        farthest = farthest_point(A[alive], relaxed[alive], A[k], inside)
        alive[k] = A[k] @ farthest > b[k] + 1e-10
    return [int(k) for k in np.flatnonzero(alive[: len(rows)])]
