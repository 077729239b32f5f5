"""Checks that critical regions are those of the quadratic program they came from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control.explicit.budget import (
    BudgetTimer,
    effort_of_conditions,
    effort_of_lp,
    effort_of_qp,
)
from sb3_yann.control.explicit.parametric_qp import (
    Optimality,
    ParametricQP,
    as_bits,
    batches,
    optimality,
)
from sb3_yann.control.polyhedra import Region, farthest_points, largest_ball

LAW_TOL = 1e-6
"""How far a law may be off, in half-widths of the input range."""
INSIDE_TOL = 1e-8
"""How far a point may lie from a region that holds it, in half-widths of the box."""
SLIVER = 1e-6  # half-widths of theta, so thin that rounding decides where a region ends
IMPLIED_TOL = 1e-9
"""How far a region may reach beyond its conditions, and equal half-spaces may differ."""


class ExplicitSolutionError(RuntimeError):
    """An explicit solution failed its check: it does not solve the program it came from."""


@dataclass(eq=False)
class Certificate:
    """The check of the regions of a scaled program, without trust in what found them.

    - An independent QP is solved at the innermost point of every region.
    - The law of every region solves the Karush-Kuhn-Tucker (KKT) equations of its active set, and
      its half-spaces imply their inequalities: then it is optimal in all of the region.
    - Across each facet where constraint k becomes active, or inactive, lie the regions of the
      active sets with k added, or removed, or in the place of another: their KKT conditions agree
      on the facet, so they cover all of its other side. Or k contradicts the active constraints
      there. Where a region is missing, a QP just across the middle of the facet must be infeasible,
      or another region there.
    - QPs at random points of the box agree with the region there, or are infeasible.
    - No region lies in another one.

    Of U only the first input, ``to_inputs`` (m, v) of it, is the law: later ones, which are not
    played, may be far steeper. ``center`` and ``half`` (n,) take theta to the units of the problem.
    Where inputs are ``demanded`` by far more than their range, regions are thin beside the box.
    """

    program: ParametricQP
    regions: list[Region]
    to_inputs: Array
    center: Array
    half: Array
    timer: BudgetTimer
    demanded: float = 0.0

    def __post_init__(self) -> None:
        self.outer = np.column_stack(self.program.theta_rows())
        self.qp_effort = effort_of_qp(*self.program.G.shape)

    def check(self) -> list[Region]:
        """Return the regions, with the laws of steep ones more exact, and trimmed by 1e-8 at most.

        Raise ExplicitSolutionError, with a theta that shows what is wrong, unless all pass.
        """
        if not self.regions:
            self._fail("no region was found", self.center * 0)
        regions = self.regions
        self.by_set = {as_bits(region.active_set): i for i, region in enumerate(regions)}
        self.A = np.concatenate([region.A for region in regions])
        self.b = np.concatenate([region.b for region in regions])
        self.laws = np.array([self.to_inputs @ region.law for region in regions])
        self.starts = np.cumsum([0, *(len(region.b) for region in regions[:-1])])
        self.balls = [region.ball() for region in regions]
        # Two looks at each region.
        self.timer.stage("regions checked", "and not all were checked", 2 * len(self.balls))
        for i, (middle, radius) in enumerate(self.balls):
            self.timer.tick(self.qp_effort)
            U = self.program.solve(middle)  # None in slivers along the edge of the feasible set
            if radius > SLIVER if U is None else self._is_wrong(i, middle, U):
                self._fail(f"the law of region {i} is not optimal inside it", middle)
            self.timer.advance()
        refined = list(regions)
        v, n = self.program.F.shape
        rows = len(self.program.w)
        sets = [region.active_set for region in regions]
        for size, members in batches(
            map(len, sets), lambda size: (v + size) * (v + size + rows + n + 1)
        ):
            self.timer.tick(len(members) * effort_of_conditions(rows + n, v + size, v + size))
            found = optimality(self.program, [sets[k] for k in members])
            for i, conditions in zip(members, found, strict=True):
                refined[i] = self._checked(i, conditions)
                self.timer.advance()
        self._require_agreement()
        self._require_no_doubles()
        return refined

    def _error(self, regions: NDArray[np.intp], points: Array, inputs: Array) -> Array:
        """Return how far laws are from the answers of a QP at points, beyond what the QP is.

        Constraints that hold to 1e-11 move its answer by so much times the slope of the law.
        """
        laws = self.laws[regions]
        gains = laws[..., :-1]
        off = np.einsum("kvn,kn->kv", gains, points) + laws[..., -1] - inputs @ self.to_inputs.T
        return np.asarray(np.abs(off).max(axis=1) - 1e-10 * np.abs(gains).sum(axis=2).max(axis=1))

    def _is_wrong(self, i: int, point: Array, U: Array) -> bool:
        """Return whether the law of region i is not the answer of a QP at a point."""
        return bool(self._error(np.array([i]), point[None], U[None])[0] > LAW_TOL)

    def _checked(self, i: int, kkt: Optimality) -> Region:
        """Return region i, trimmed, with the exact law where that is steep; raise if wrong."""
        region = self.regions[i]
        exact = self.to_inputs @ kkt.law
        error = np.abs(exact - self.laws[i]).max()
        if error > LAW_TOL * (1 + np.abs(exact).max()):
            self._fail(f"the law of region {i} is not optimal inside it", self.balls[i][0])
        own = np.column_stack([region.A, region.b])
        known = np.concatenate([self.outer, kkt.rows])
        same = np.abs(own[:, None] - known[None]).max(axis=2) < IMPLIED_TOL
        missing = self._missing(i, np.any(same[:, len(self.outer) :], axis=0), kkt)
        self._require_neighbors(i, same, kkt)
        if len(missing):
            across = region.across
            if across:
                across += tuple(self._beyond(kkt.across(row)) for row in missing)
            A = np.concatenate([region.A, kkt.rows[missing, :-1]])
            b = np.append(region.b, kkt.rows[missing, -1])
            region = replace(region, A=A, b=b, across=across)
        if np.abs(kkt.law[:, :-1]).max() > 1e3:  # the walk's QR factors leave it off by 1e-13
            region = replace(region, law=kkt.law)
        return region

    def _missing(self, i: int, known: NDArray[np.bool_], kkt: Optimality) -> NDArray[np.intp]:
        """Return which conditions the half-spaces of region i just do not imply.

        They are left out where they seem to touch the region alone. Raise if it lies farther
        beyond one, and its law is another there; ``known`` marks those among the half-spaces.
        """
        region = self.regions[i]
        inside, radius = self.balls[i]
        n = len(inside)
        if radius <= 0 or np.any(kkt.rows[:, n] + IMPLIED_TOL < kkt.rows[:, :n] @ inside):
            self._fail(f"the law of region {i} violates the KKT conditions", inside)
        others = np.flatnonzero(~known)
        if not len(others):
            return others
        rows = kkt.rows[others]
        self.timer.tick(len(rows) * effort_of_lp(*region.A.shape) / 2)
        points = farthest_points(region.A, region.b, inside, rows[:, :n])
        beyond = np.sum(rows[:, :n] * points, axis=1) - rows[:, n]
        worst = int(np.argmax(beyond))
        if beyond[worst] > INSIDE_TOL:
            at = points[worst]
            U = self.program.solve(at)  # None beyond the feasible set, of which this is the edge
            if beyond[worst] > SLIVER or (U is not None and self._is_wrong(i, at, U)):
                self._fail(f"the law of region {i} violates the KKT conditions", at)
        return np.asarray(others[beyond > IMPLIED_TOL])

    def _beyond(self, candidates: Iterable[int]) -> tuple[int, ...] | None:
        """Return the active set of the first of these that is a region, None if none is."""
        at = next((self.by_set[each] for each in candidates if each in self.by_set), None)
        return None if at is None else self.regions[at].active_set

    def _require_neighbors(self, i: int, same: NDArray[np.bool_], kkt: Optimality) -> None:
        """Raise if a facet of region i has no neighbor; ``same`` says which conditions are it."""
        outer = len(self.outer)
        for row, known in enumerate(same):
            # A bound of theta, or a constraint.
            if not any(
                each < outer or all(a in self.by_set for a in kkt.across(each - outer))
                for each in np.flatnonzero(known).tolist()
            ):
                self._require_covered_across(i, row)

    def _require_covered_across(self, i: int, row: int) -> None:
        """Raise if no region touches a facet from the other side where that is feasible.

        In a wide box a law that jumps there is looked at closely: between may lie regions that are
        too thin to be met.
        """
        region = self.regions[i]
        self.timer.tick(effort_of_lp(*region.A.shape) + self.qp_effort)
        middle, distance = largest_ball(region.A, region.b, row)
        for step in (1e-5, 1e-6, 1e-7):
            point = middle + step * region.A[row]
            # A half-space that only touches the region has no facet to cross.
            if distance <= step or np.any(self.outer[:, :-1] @ point > self.outer[:, -1]):
                continue
            U, multipliers = self.program.solve_with_multipliers(point)
            if U is None:
                return
            at = self.by_set.get(as_bits(np.flatnonzero(multipliers > 1e-11)))
            if at is not None:
                other = self.regions[at]
                if min(np.min(other.b - other.A @ x) for x in (point, middle)) >= -INSIDE_TOL:
                    jump = (self.laws[at] - self.laws[i]) @ np.append(middle, 1.0)
                    if self.demanded > 1e4 and np.abs(jump).max() > LAW_TOL:
                        outward = region.A[row]
                        self._require_right([middle + k * outward for k in (1e-10, 1e-9, 1e-8)])
                    return
            slacks = self._slacks(point)
            if np.max(slacks) < -INSIDE_TOL:
                self._fail("no region covers a feasible parameter", point)
            if np.any(self._slacks(middle)[slacks >= -INSIDE_TOL] >= -INSIDE_TOL):
                return

    def _slacks(self, points: Array) -> Array:
        """Return how far inside each region points (..., n) lie."""
        return np.asarray(np.minimum.reduceat(self.b - points @ self.A.T, self.starts, axis=-1))

    def _require_agreement(self) -> None:
        """Raise unless QPs at random points of the box agree with the regions."""
        n = self.program.F.shape[1]
        rng = np.random.default_rng(1)
        for points in [*rng.uniform(-1, 1, (n, 50, n)), *self._points_near_regions(rng)]:
            self.timer.tick(50 * self.qp_effort)
            self._require_right(points)

    def _require_right(self, points: Iterable[Array]) -> None:
        """Raise unless QPs at points (n,) agree with the regions there."""
        solved = [(point, self.program.solve(point)) for point in points]
        feasible = [(point, U) for point, U in solved if U is not None]
        if not feasible:
            return
        at, inputs = (np.array(each) for each in zip(*feasible, strict=True))
        slacks = self._slacks(at)
        nearest = np.argmax(slacks, axis=1)
        k = int(np.argmin(slacks.max(axis=1)))
        if slacks[k, nearest[k]] < -INSIDE_TOL:
            self._fail("no region covers a feasible parameter", at[k])
        error = self._error(nearest, at, inputs)
        k = int(np.argmax(error))
        if error[k] > LAW_TOL:
            self._fail(f"the law of region {nearest[k]} violates the KKT conditions", at[k])

    def _points_near_regions(self, rng: np.random.Generator) -> Iterator[Array]:
        """Yield points (200, n) at all distances from regions that a wide box makes thin."""
        n = self.program.F.shape[1]
        rest = np.clip(-self.center / self.half, -1, 1)
        middles = np.array([rest, *(middle for middle, _ in self.balls)])
        for _ in range(20 if self.demanded > 1e4 else 0):
            # Half of them about the operating point.
            chosen = middles[rng.integers(len(middles), size=200) * rng.integers(2, size=200)]
            far = 10 ** rng.uniform(-10, 0, (200, 1)) * rng.uniform(-1, 1, (200, n))
            yield np.clip(chosen + far, -1, 1)

    def _require_no_doubles(self) -> None:
        """Raise if a region lies in another: both have then the same law, whatever their sets."""
        laws = np.array([region.law.ravel() for region in self.regions])
        keys = laws @ np.random.default_rng(0).normal(size=laws.shape[1])
        order = np.argsort(keys)
        near = np.flatnonzero(np.diff(keys[order]) < LAW_TOL * (1 + np.abs(keys[order][:-1])))
        for i, j in zip(order[near], order[near + 1], strict=True):
            A = np.concatenate([self.regions[i].A, self.regions[j].A])
            b = np.concatenate([self.regions[i].b, self.regions[j].b])
            self.timer.tick(effort_of_lp(*A.shape))
            middle, radius = largest_ball(A, b)
            if radius > 0.99 * min(self.balls[i][1], self.balls[j][1]):
                self._fail(f"region {min(i, j)} and region {max(i, j)} are the same", middle)

    def _fail(self, what: str, theta: Array) -> NoReturn:
        place = theta * self.half + self.center
        raise ExplicitSolutionError(
            f"The explicit solution failed its check: {what}, at theta = {place.tolist()} from the "
            "operating point. The problem is likely to be badly conditioned: shorten the horizon, "
            "bring states and weights to similar magnitudes, or use online(), which needs no "
            "regions."
        )
