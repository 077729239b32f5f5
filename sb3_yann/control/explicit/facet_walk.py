"""A walk over the critical regions of a quadratic program, from facet to facet."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control.explicit.budget import BudgetTimer, effort_of_lp
from sb3_yann.control.explicit.conditions import (
    OUTER,
    THINNEST,
    Conditions,
    Found,
    members_of,
)
from sb3_yann.control.explicit.parametric_qp import ParametricQP
from sb3_yann.control.polyhedra import Region, largest_ball


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
        self.conditions = Conditions(program, timer)
        self.found: dict[int, Found] = {}
        self.seen: set[int] = set()
        self.random = np.random.default_rng(0)

    def regions(self) -> list[Region]:
        kept = self.conditions.kept
        rows = {each: tuple(kept[members_of(each)].tolist()) for each in self.found}
        across = {
            each: tuple(
                next((rows[other] for other in one.across(k) if other in rows), None)
                for k in range(len(one.labels))
            )
            for each, one in self.found.items()
        }
        return [
            Region(rows[k], one.law[:, :-1], one.law[:, -1], one.A, one.b, one.inside, across[k])
            for k, one in self.found.items()
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
        facets: list[tuple[Found, int]] = []
        while ahead:
            self.seen.update(ahead)
            following: set[int] = set()
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

    def _open(self, one: Found, row: int) -> bool:
        """Tell whether it is not known what lies across a facet."""
        if one.labels[row] == OUTER:
            return False
        across = one.across(row)
        known = any(active in self.found for active in across)
        return not known or not self.conditions.degenerate.isdisjoint(across)

    def _across(self, one: Found, row: int) -> int | None:
        """Return the active set across a facet, None if none is new or feasible there."""
        self.timer.tick(effort_of_lp(*one.A.shape))
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
