"""Checks that critical regions are those of the quadratic program they came from."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NoReturn

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control.explicit.parametric_qp import ParametricQP, as_bits, batches
from sb3_yann.control.polyhedra import Region, facets, farthest_point, largest_ball

# How far a law may be off, and a point from a region that holds it, in half-widths of the ranges.
LAW, INSIDE = 1e-6, 1e-8


class ExplicitSolutionError(RuntimeError):
    """An explicit solution failed its check: it does not solve the program it came from.

    Examples
    --------
    >>> issubclass(ExplicitSolutionError, RuntimeError)
    True
    """


def _sets(multipliers: Array) -> list[int]:
    """Return the sets of constraints with multipliers, one for each row, as whole numbers."""
    bits = np.packbits(multipliers > 1e-11, axis=1, bitorder="little")
    return [int.from_bytes(row.tobytes(), "little") for row in bits]


class Certificate:
    """The check of the regions of a scaled program, without trust in what found them.

    - An independent QP is solved at the innermost point of every region.
    - The law of every region solves the Karush-Kuhn-Tucker (KKT) equations of its active set, and
      its half-spaces imply their inequalities: then it is optimal in all of the region.
    - Across each facet where constraint k becomes active, or inactive, lies the region of the
      active set with k added, or removed: their KKT conditions agree on the facet, so it covers
      all of its other side. Where there is no such region, a QP just across the middle of the facet
      must be infeasible, or another region there.
    - QPs at random points of the box agree with the region there, or are infeasible.
    - No region lies in another one.

    Parameters
    ----------
    program, regions : ParametricQP, list of Region
        The scaled program, and what was found.
    center, half : ndarray, shape (n,)
        Take theta to the units of the problem.
    """

    def __init__(
        self, program: ParametricQP, regions: list[Region], center: Array, half: Array
    ) -> None:
        self.program, self.regions, self.center, self.half = program, regions, center, half
        self.by_set = {as_bits(region.active_set): i for i, region in enumerate(regions)}
        self.outer = np.column_stack(program.theta_rows())

    def check(self) -> None:
        """Raise ExplicitSolutionError, with a theta that shows what is wrong, unless all pass."""
        if not self.regions:
            self._fail("no region was found", self.center * 0)
        self.A, self.b = (
            np.concatenate([getattr(region, name) for region in self.regions]) for name in "Ab"
        )
        self.starts = np.cumsum([0, *(len(region.b) for region in self.regions[:-1])])
        balls = [region.ball() for region in self.regions]
        for i, (region, (inside, _)) in enumerate(zip(self.regions, balls, strict=True)):
            U = self.program.solve(inside)
            if U is None or np.max(np.abs(U - region.gain @ inside - region.offset)) > LAW:
                self._fail(f"the law of region {i} is not optimal inside it", inside)
        for i, law, rows, labels in self._conditions():
            self._require_law(i, law, balls[i][0])
            self._require_implied(i, rows, *balls[i])
            self._require_neighbors(i, rows, labels)
        self._require_agreement()
        self._require_no_doubles(balls)

    def _conditions(self) -> Iterator[tuple[int, Array, Array, list[int]]]:
        """Yield the KKT conditions of each region: its law, and rows [A b] with labels."""
        for size, members in batches(len(region.active_set) for region in self.regions):
            yield from self._conditions_of(members, size)

    def _conditions_of(
        self, members: list[int], size: int
    ) -> Iterator[tuple[int, Array, Array, list[int]]]:
        program, (v, n) = self.program, self.program.F.shape
        active = np.array([self.regions[i].active_set for i in members], dtype=int)
        active, limit = active.reshape(len(members), size), np.column_stack([program.S, program.w])
        K = np.zeros((len(members), v + size, v + size))
        K[:, :v, :v] = program.H
        K[:, v:, :v] = program.G[active]
        K[:, :v, v:] = np.swapaxes(program.G[active], 1, 2)
        right = np.empty((len(members), v + size, n + 1))
        right[:, :v] = -np.column_stack([program.F, program.c])
        right[:, v:] = limit[active]
        try:
            both = np.linalg.solve(K, right)
        except np.linalg.LinAlgError:
            self._fail("the active constraints of a region depend on each other", self.center * 0)
        laws, multipliers = both[:, :v], both[:, v:]
        rows = limit - program.G @ laws
        noise = 1 + np.linalg.norm(laws, axis=(1, 2))[:, None] * np.ones(len(program.w))
        each = np.arange(len(members))[:, None]
        rows[each, active] = multipliers
        noise[each, active] = np.abs(multipliers).max(axis=(1, 2), initial=0.0)[:, None]
        length = np.linalg.norm(rows[:, :, :n], axis=2)
        fixed = length <= 1e-11 * noise
        length[fixed] = np.maximum(noise[fixed], 1e-300)
        rows = np.concatenate([-rows[:, :, :n], rows[:, :, n:]], axis=2) / length[:, :, None]
        rows[fixed, :n] = 0.0
        binding = rows[:, :, n] < np.abs(rows[:, :, :n]).sum(axis=2)
        for k, i in enumerate(members):
            yield i, laws[k], rows[k, binding[k]], np.flatnonzero(binding[k]).tolist()

    def _require_law(self, i: int, law: Array, inside: Array) -> None:
        region = self.regions[i]
        off = max(np.abs(law[:, :-1] - region.gain).max(), np.abs(law[:, -1] - region.offset).max())
        if off > LAW * (1 + np.abs(law).max()):
            self._fail(f"the law of region {i} is not optimal inside it", inside)

    def _require_implied(self, i: int, rows: Array, inside: Array, radius: float) -> None:
        """Raise unless the half-spaces of region i imply all rows."""
        region, n = self.regions[i], len(inside)
        A, b = np.concatenate([rows[:, :n], region.A]), np.concatenate([rows[:, n], region.b])
        b[: len(rows)] += 1e-4 * radius
        if radius <= 0 or np.any(rows[:, n] < rows[:, :n] @ inside - LAW):
            self._fail(f"the law of region {i} violates the KKT conditions", inside)
        for k in facets(A, b, inside, radius):
            if k >= len(rows):
                break
            # Within DAQP's tolerance it may count: the farthest point decides.
            point = farthest_point(region.A, region.b, rows[k, :n])
            if rows[k, :n] @ point > rows[k, n] + LAW:
                self._fail(f"the law of region {i} violates the KKT conditions", point)

    def _require_neighbors(self, i: int, rows: Array, labels: list[int]) -> None:
        region = self.regions[i]
        known = np.concatenate([self.outer, rows])
        own = np.column_stack([region.A, region.b])
        same = np.abs(own[:, None] - known[None]).max(axis=2) < 1e-9
        first = len(self.outer)
        meant: list[list[int]] = [[] for _ in own]
        for row, which in zip(*(index.tolist() for index in np.nonzero(same)), strict=True):
            meant[row].append(which - first)
        active = as_bits(region.active_set)
        for row, which in enumerate(meant):
            outer = bool(which) and which[0] < 0  # a bound of theta
            if not outer and not any(active ^ (1 << labels[k]) in self.by_set for k in which):
                self._look_across(region, row)

    def _look_across(self, region: Region, row: int) -> None:
        """Raise if no region touches a facet from the other side where that is feasible."""
        middle, distance = largest_ball(region.A, region.b, row)
        for step in (1e-5, 1e-6, 1e-7):
            point = middle + step * region.A[row]
            # A half-space that only touches the region has no facet to cross.
            if distance <= step or np.any(self.outer[:, :-1] @ point > self.outer[:, -1]):
                continue
            U, multipliers = self.program.solve_with_multipliers(point)
            if U is None:
                return
            at = self.by_set.get(_sets(multipliers[None])[0])
            other = None if at is None else self.regions[at]
            if other and all(np.min(other.b - other.A @ x) >= -INSIDE for x in (point, middle)):
                return
            slacks = self._slacks(point)
            if np.max(slacks) < -INSIDE:
                self._fail("no region covers a feasible parameter", point)
            holders = slacks >= -INSIDE
            if np.any(self._slacks(middle)[holders] >= -INSIDE):
                return

    def _slacks(self, point: Array) -> Array:
        return np.asarray(np.minimum.reduceat(self.b - self.A @ point, self.starts))

    def _require_agreement(self) -> None:
        """Raise unless QPs at random points of the box agree with the regions."""
        n = self.program.F.shape[1]
        drawn = np.random.default_rng(1).uniform(-1, 1, (50 * n, n))
        solved = [(point, *self.program.solve_with_multipliers(point)) for point in drawn]
        feasible = [each for each in solved if each[1] is not None]
        if not feasible:
            return
        points, inputs, multipliers = (np.array(each) for each in zip(*feasible, strict=True))
        meant = np.array([self.by_set.get(each, -1) for each in _sets(multipliers)])
        held = meant >= 0
        for i in np.unique(meant[held]):
            region, at = self.regions[i], np.flatnonzero(meant == i)
            held[at] = (region.b - points[at] @ region.A.T).min(axis=1) >= -INSIDE
            off = np.abs(points[at] @ region.gain.T + region.offset - inputs[at]).max(axis=1)
            wrong = at[held[at] & (off > LAW)]
            if len(wrong):
                self._fail(f"the law of region {i} violates the KKT conditions", points[wrong[0]])
        for k in np.flatnonzero(~held):
            self._require_held(points[k], inputs[k])

    def _require_held(self, point: Array, U: Array) -> None:
        """Raise unless the region that is nearest to a point holds it, and has the right law."""
        slacks = self._slacks(point)
        nearest = int(np.argmax(slacks))
        region = self.regions[nearest]
        if slacks[nearest] < -INSIDE:
            self._fail("no region covers a feasible parameter", point)
        if np.max(np.abs(U - region.gain @ point - region.offset)) > LAW:
            self._fail(f"the law of region {nearest} violates the KKT conditions", point)

    def _require_no_doubles(self, balls: list[tuple[Array, float]]) -> None:
        """Raise if a region lies in another: both have then the same law, whatever their sets."""
        laws = np.array([np.append(region.gain.ravel(), region.offset) for region in self.regions])
        keys = laws @ np.random.default_rng(0).normal(size=laws.shape[1])
        order = np.argsort(keys)
        near = np.flatnonzero(np.diff(keys[order]) < LAW * (1 + np.abs(keys[order][:-1])))
        for i, j in zip(order[near], order[near + 1], strict=True):
            one, two = self.regions[i], self.regions[j]
            A, b = np.concatenate([one.A, two.A]), np.concatenate([one.b, two.b])
            middle, radius = largest_ball(A, b)
            if radius > 0.99 * min(balls[i][1], balls[j][1]):
                self._fail(f"region {min(i, j)} and region {max(i, j)} are the same", middle)

    def _fail(self, what: str, theta: Array) -> NoReturn:
        place = theta * self.half + self.center
        raise ExplicitSolutionError(
            f"The explicit solution failed its check: {what}, at theta = {place.tolist()}. The "
            "problem is likely to be badly conditioned: shorten the horizon, or bring states and "
            "weights to similar magnitudes."
        )
