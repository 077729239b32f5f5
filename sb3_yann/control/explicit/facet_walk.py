"""The critical regions of a quadratic program, found by a walk from facet to facet."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
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
from sb3_yann.control.explicit.parametric_qp import (
    DEPENDENT,
    ParametricQP,
    as_bits,
    batches,
    members_of,
    row_units,
)
from sb3_yann.control.polyhedra import (
    Region,
    bounded_region,
    equal_rows,
    farthest_points,
    largest_ball,
)

THINNEST = 1e-9
"""Regions that hold no ball of this radius, in half-widths of the box, are left out."""
PERTURBED = 1e-8
"""How far unit rows are moved out, in half-widths, so that one of several active sets is told:
above the tolerance of the QP, 1e-11, and below the step across a facet, 1e-7."""


def walk(program: ParametricQP, timer: BudgetTimer) -> list[Region]:
    """Return the critical regions of a program with unit rows whose box is the unit box.

    Across a facet where constraint k becomes active, or inactive, lies the region of the active
    set with k added, or removed. If k depends on the active constraints, it takes the place of one
    of those that it contains with a positive factor; if there is none, nothing feasible lies there
    (Farkas' lemma). Where these sets have no region, a QP just across the middle of the facet shows
    what lies there. Last, QPs at random points look for what the walk has not met. Sets of
    constraints are whole numbers, with bit k for k.
    """
    search = _Walk(program, timer)
    search.explore(search.seeds(20))
    for _ in range(10):
        missed = set(search.seeds(100 * program.F.shape[1])) - search.visited
        if not missed:
            break
        search.explore(missed)
    return search.regions()


Beyond = list[tuple[int, ...] | None]
"""The active sets that share each facet of a region if nothing degenerates, an empty tuple where
several constraints do, and None where nothing feasible lies beyond."""


class _Walk:
    """The regions that were found, and the active sets that were visited."""

    def __init__(self, program: ParametricQP, timer: BudgetTimer) -> None:
        self.timer = timer
        self.conditions = Conditions(program, timer)
        self.found: dict[int, Region] = {}
        self.beyond: dict[int, Beyond] = {}
        self.visited: set[int] = set()
        self.random = np.random.default_rng(0)

    def regions(self) -> list[Region]:
        """Return the regions, with the regions across their facets that were found too."""

        def first(candidates: tuple[int, ...] | None) -> tuple[int, ...] | None:
            known = (self.found[each] for each in candidates or () if each in self.found)
            return next((one.active_set for one in known), None)

        return [
            replace(one, across=tuple(map(first, self.beyond[active])))
            for active, one in self.found.items()
        ]

    def seeds(self, count: int) -> Iterator[int]:
        """Yield the active sets where no region is known, at random points of the feasible set."""
        corners = self.conditions.corners
        middle = self.conditions.middle
        weights = self.random.dirichlet(np.ones(len(corners)), count)
        points = np.vstack([0 * middle, middle, 0.9 * weights @ corners + 0.1 * middle])
        known = np.zeros(len(points), dtype=bool)
        for one in self.found.values():
            known |= np.all(points @ one.A.T <= one.b, axis=1)
        for point in points[~known]:
            active = self.conditions.active_at(point)
            if active is not None:
                yield active

    def explore(self, wave: Iterable[int]) -> None:
        """Add all regions that are connected with those of some active sets."""
        ahead = sorted(set(wave) - self.visited)
        facets: list[tuple[int, int]] = []
        while ahead:
            self.visited.update(ahead)
            following: set[int] = set()
            for active, one, beyond in self.conditions.regions(ahead):
                self.timer.count()
                self.found[active] = one
                self.beyond[active] = beyond
                facets += [(active, k) for k, each in enumerate(beyond) if each is not None]
                following.update(*filter(None, beyond))
            ahead = sorted(following - self.visited)
            if not ahead:  # the facets across which these sets have no region
                left = [(pair, self._across(*pair)) for pair in facets]
                ahead = sorted({active for _, active in left if active is not None})
                facets = [pair for pair, active in left if active is not None]

    def _across(self, own: int, row: int) -> int | None:
        """Return the active set across a facet, None if it is known, or none is feasible there."""
        one = self.found[own]
        across = self.beyond[own][row] or ()
        known = any(active in self.found for active in across)
        if known and self.conditions.degenerate.isdisjoint(across):
            return None
        self.timer.tick(effort_of_lp(*one.A.shape))
        middle, distance = largest_ball(one.A, one.b, row)
        if distance <= THINNEST:  # the row only touches the region
            return None
        # The shortest step that gives an answer: a longer one may cross a thin region.
        for step in (1e-7, 1e-6, 1e-5):
            point = middle + min(step, distance) * one.A[row]
            active = self.conditions.active_at(point)
            if active is None:
                return None
            if active not in self.visited:
                return active
            other = self.found.get(active, one)
            slacks = [np.min(other.b - other.A @ each) for each in (middle, point)]
            if other is not one and min(slacks) >= -1e-9:
                return None
        return None


@dataclass(frozen=True, eq=False)
class _Factors:
    """QR factors of some active sets of one size: ``N[index]' = Q R``.

    ``inverse`` is that of R, ``NQ`` is N Q, and ``depends`` marks the constraints that are
    combinations of the active ones.
    """

    index: NDArray[np.intp]
    Q: Array
    inverse: Array
    NQ: Array
    depends: NDArray[np.bool_]


class Conditions:
    """The Karush-Kuhn-Tucker conditions of a program as functions of theta, for many active sets.

    With ``H = LL'`` and ``z = L'U`` the program is to find the shortest ``z + Y [theta; 1]`` with
    ``N z <= w + S theta``: the active rows are then all that a region needs to factor.
    """

    def __init__(self, program: ParametricQP, timer: BudgetTimer) -> None:
        self.timer = timer
        self.outer_A, self.outer_b = program.theta_rows()
        self._bound_feasible_set(program, np.flatnonzero(np.any(program.G, axis=1)))
        timer.tick()
        L = np.linalg.cholesky(program.H)
        self.back = np.linalg.inv(L).T
        self.Y = np.linalg.solve(L, np.column_stack([program.F, program.c]))
        self.N = program.G[self.kept] @ self.back
        self.length = np.linalg.norm(self.N, axis=1)
        # The slack that each constraint has where none is active.
        self.D = np.column_stack([program.S, program.w])[self.kept] + self.N @ self.Y
        # Where constraints that depend on each other are all tight over a region, several active
        # sets have its law. Those count that are right with each constraint moved out a little.
        self.apart = np.random.default_rng(0).uniform(0.5, 1.5, len(self.kept))
        # Active sets that depend on each other, or share their law with another one.
        self.degenerate: set[int] = set()
        self.units = row_units(self.N)
        self.least_distance = replace(
            program,
            H=np.eye(len(self.back)),
            F=0 * program.F,
            c=0 * program.c,
            G=self.N,
            w=self.D[:, -1] + PERTURBED * self.apart,
            S=self.D[:, :-1],
        )

    def _bound_feasible_set(self, program: ParametricQP, moving: NDArray[np.intp]) -> None:
        """Set a point and the corners of the feasible theta, and the constraints that bound it."""
        v, n = program.F.shape
        rows = np.vstack([
            np.hstack([program.G[moving], -program.S[moving]]),
            np.hstack([np.zeros((len(self.outer_b), v)), self.outer_A]),
        ])  # fmt: skip
        b = np.concatenate([program.w[moving], self.outer_b])
        self.timer.tick(effort_of_lp(*rows.shape))
        inside, _ = largest_ball(rows, b)

        def farthest(kept: NDArray[np.bool_], limits: Array, direction: Array) -> Array:
            effort = effort_of_lp(np.count_nonzero(kept), v + n)
            self.timer.tick(effort)
            # Only HiGHS can be interrupted where a single program takes long.
            seconds = self.timer.left() if effort > 0.1 else None
            found = farthest_points(rows[kept], limits[kept], inside, direction[None], seconds)
            self.timer.tick()
            return np.asarray(found[0])

        self.middle = inside[v:]
        alive = np.ones(len(b), dtype=bool)
        axes = np.hstack([np.zeros((2 * n, v)), np.vstack([np.eye(n), -np.eye(n)])])
        # The theta that are farthest along every axis (2 n, n).
        self.corners = np.array([farthest(alive, b, axis)[v:] for axis in axes])
        for k in reversed(range(len(moving))):  # of rows that say the same, the first
            relaxed = b.copy()
            relaxed[k] += 1.0
            alive[k] = rows[k] @ farthest(alive, relaxed, rows[k]) > b[k] + 1e-10
        self.kept = moving[np.flatnonzero(alive[: len(moving)])]

    def active_at(self, theta: Array) -> int | None:
        """Return DAQP's working set at theta, None if infeasible by more than `PERTURBED`.

        With constraints moved apart: of several sets with one law it is that which has a region.
        """
        if np.any(self.outer_A @ theta > self.outer_b + 1e-11):
            return None
        if not len(self.kept):
            return 0
        self.timer.tick(effort_of_qp(*self.N.shape))
        U, multipliers = self.least_distance.solve_with_multipliers(theta)
        if U is None:
            return None
        multipliers = multipliers / self.units  # of rows of about unit length
        return as_bits(np.flatnonzero(multipliers > 1e-11 * max(1.0, multipliers.max())))

    def regions(self, wave: list[int]) -> Iterator[tuple[int, Region, Beyond]]:
        """Yield those of some active sets that have a region with an interior, and that region."""
        rows, v = self.N.shape
        width = v + self.outer_A.shape[1] + 1
        sizes = (active.bit_count() for active in wave)
        for size, members in batches(sizes, lambda size: (rows + v) * (size + width)):
            if size <= v:
                self.timer.tick(len(members) * effort_of_conditions(rows, v, size))
                yield from self._regions([wave[i] for i in members], size)

    def _regions(self, members: list[int], size: int) -> Iterator[tuple[int, Region, Beyond]]:
        factors, independent = self._factored(members, size)
        actives = [members[i] for i in np.flatnonzero(independent)]
        self.degenerate.update(members[i] for i in np.flatnonzero(~independent))
        laws, rows, noise = self._rows(factors)
        index = factors.index
        each = np.arange(len(index))[:, None]
        length = np.linalg.norm(rows[:, :, :-1], axis=2)
        constant = length <= 1e-12 * noise
        # Something violated everywhere; or a multiplier that is zero everywhere: the region is that
        # of a smaller active set.
        ok = ~np.any(constant & (rows[:, :, -1] < -1e-10 * noise), axis=1)
        weak = constant[each, index] & (rows[each, index, -1] <= 1e-10 * noise[each, index])
        ok &= ~np.any(weak, axis=1)
        tight = constant & (np.abs(rows[..., -1]) <= 1e-10 * noise)
        # Wrong with constraints moved apart, where others than the active ones are tight.
        tight[each, index] = False
        moved = np.swapaxes(factors.inverse, 1, 2) @ self.apart[index][:, :, None]
        apart = self.apart - np.squeeze(factors.NQ @ moved, axis=2)
        ruled_out = ok & np.any(tight & (apart < 0), axis=1)
        self.degenerate.update(actives[i] for i in np.flatnonzero(ruled_out))
        length[constant] = 1.0
        A = -rows[:, :, :-1] / length[:, :, None]
        b = rows[:, :, -1] / length
        reach = np.sum(np.abs(A), axis=2)
        ok &= ~ruled_out & ~np.any((b < THINNEST - reach) & ~constant, axis=1)
        needed = (b < reach - 1e-12) & ~constant
        for i in np.flatnonzero(ok):
            label = np.flatnonzero(needed[i])
            bounds = len(label) + len(self.outer_b)
            self.timer.tick(OF_REGION + bounds * effort_of_lp(bounds, A.shape[2]) / 2)
            outer = np.concatenate([A[i, label], self.outer_A])
            ends = np.concatenate([b[i, label], self.outer_b])
            inside, radius, facets, some_equal = bounded_region(outer, ends, THINNEST)
            if radius <= THINNEST:
                continue
            added = label[facets[facets < len(label)]]
            across = self._across(actives[i], added, factors, i)
            across += [None] * (len(facets) - len(added))
            if some_equal:  # one facet for those that share it
                same = equal_rows(outer[facets], ends[facets] - outer[facets] @ inside, radius)
                keep = np.flatnonzero(np.argmax(same, axis=1) == np.arange(len(facets)))
                twins = [[across[k] for k in np.flatnonzero(same[first])] for first in keep]
                shared = [None if None in each else () for each in twins]
                pairs = zip(twins, shared, strict=True)
                across = [each[0] if len(each) == 1 else both for each, both in pairs]
                facets = facets[keep]
            active_set = tuple(self.kept[index[i]].tolist())
            yield (
                actives[i],
                Region(active_set, laws[i], outer[facets], ends[facets], inside),
                across,
            )

    def _factored(self, members: list[int], size: int) -> tuple[_Factors, NDArray[np.bool_]]:
        """Return the QR factors of active sets of independent constraints, and which are that."""
        index = np.array([members_of(active) for active in members], dtype=int)
        index = index.reshape(len(members), size)
        Q, R = np.linalg.qr(np.swapaxes(self.N[index], 1, 2))
        pivots = np.abs(np.diagonal(R, axis1=1, axis2=2))
        full = np.all(pivots > DEPENDENT * self.length[index], axis=1)
        Q = Q[full]
        index = index[full]
        inverse = np.linalg.inv(R[full])
        NQ = self.N @ Q
        left = np.linalg.norm(self.N - NQ @ np.swapaxes(Q, 1, 2), axis=2)
        depends = left <= DEPENDENT * self.length
        depends[np.arange(len(index))[:, None], index] = False
        return _Factors(index, Q, inverse, NQ, depends), full

    def _rows(self, factors: _Factors) -> tuple[Array, Array, Array]:
        """Return laws; slacks, or multipliers of active rows, as [S w]; the size of their terms."""
        index = factors.index
        W = np.swapaxes(factors.inverse, 1, 2) @ self.D[index]
        rows = self.D - factors.NQ @ W
        width = np.linalg.norm(W, axis=(1, 2))[:, None]
        noise = np.linalg.norm(self.D, axis=1) + np.linalg.norm(factors.NQ, axis=2) * width
        each = np.arange(len(index))[:, None]
        rows[each, index] = -factors.inverse @ W
        noise[each, index] = np.linalg.norm(factors.inverse, axis=2) * width
        return self.back @ (factors.Q @ W - self.Y), rows, noise

    def _across(self, active: int, added: NDArray[np.intp], factors: _Factors, i: int) -> Beyond:
        """Return the active sets beyond constraints, None where nothing feasible lies there.

        Of those that a constraint is made up of, one with a positive factor leaves.
        """
        index = factors.index[i]
        made_of = factors.NQ[i, added] @ factors.inverse[i].T * self.length[index]
        leaves = made_of > DEPENDENT * self.length[added, None]
        found: Beyond = []
        for k, leave in zip(added.tolist(), leaves, strict=True):
            flipped = active ^ (1 << k)
            exchanged = tuple(flipped ^ (1 << j) for j in index[leave].tolist())
            found.append(exchanged or None if factors.depends[i, k] else (flipped,))
        return found
