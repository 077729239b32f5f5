"""Programs whose slacks cost so much more than inputs that a dual method has too few digits left.

In a dual method a slack is what is left when large numbers cancel: its digits are those of float64
less those of the penalty. In the Karush-Kuhn-Tucker (KKT) equations as they stand nothing cancels.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import fields
from functools import cached_property

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control.explicit.kkt import Optimality, optimality
from sb3_yann.control.explicit.parametric_qp import ParametricQP, as_bits

MILD = 1e7
"""Up to so many times the inputs' own cost a slack may cost for a dual method."""
STEEPEST = 1e15
"""So many times the inputs' own cost a slack costs at most.

A larger penalty moves the law by less than 1e-15 of it, and KKT equations become singular.
"""
HELD = 1e-9
"""So far beyond the conditions of an active set, in half-widths of the box, a point is in them."""
MOST_STEPS, MOST_KNOWN = 100, 1 << 12
"""Active sets that are tried at a point, and conditions that are kept."""


def steepness(program: ParametricQP) -> tuple[Array, Array]:
    """Return how many times the inputs' own cost each slack may cost, and the largest slacks.

    Both costs are compared where they are largest in theta's box: a slack in which a bound is
    broken by all that it can be. The program comes in units of its input range and its box.
    """
    inputs, sizes = len(program.c) - program.n_slacks, np.diag(program.H)
    extent = np.abs(program.S).sum(axis=1) + np.abs(program.G[:, :inputs]).sum(axis=1)
    own = np.abs(program.G[:, inputs:])
    most = np.divide(extent[:, None], own, out=np.zeros_like(own), where=own > 0)
    broken = np.max(most, axis=0, initial=0.0)
    broken[broken == 0] = 1.0
    return sizes[inputs:] * broken**2 / np.mean(sizes[:inputs]), broken


def solvable(program: ParametricQP) -> ParametricQP:
    """Return a program in units of its input range and its box as a SteepQP, if it is one."""
    ratio, _ = steepness(program)
    if np.all(ratio <= MILD):
        return program
    parts = {each.name: getattr(program, each.name) for each in fields(ParametricQP)}
    less = np.ones(len(program.c))
    less[len(less) - program.n_slacks :] = np.minimum(1.0, STEEPEST / ratio)
    parts["H"] = program.H * np.sqrt(np.outer(less, less))
    parts["c"] = program.c * less
    return SteepQP(**parts)


class SteepQP(ParametricQP):
    """A program of which DAQP solves a milder one, for an active set to begin with.

    The set is changed until its KKT conditions hold, and the answer is that of their equations.
    """

    steep = True

    @cached_property
    def mild(self) -> ParametricQP:
        """The program with slacks that cost what a dual method can take, in units of the largest.

        Its rows are those of this program, at most of length one.
        """
        ratio, broken = steepness(self)
        inputs, less = len(self.c) - self.n_slacks, 1 / np.maximum(1.0, ratio / MILD)
        H, c, G = self.H.copy(), self.c.copy(), self.G.copy()
        H[inputs:, inputs:] *= np.sqrt(np.outer(less, less)) * np.outer(broken, broken)
        c[inputs:] *= less * broken
        G[:, inputs:] *= broken
        # "No violation" is far longer than all other rows, which count as zero then.
        units = 1 / np.maximum(1.0, np.linalg.norm(G, axis=1))
        plain = {each.name: getattr(self, each.name) for each in fields(ParametricQP)}
        plain |= {"G": G * units[:, None], "S": self.S * units[:, None], "w": self.w * units}
        return ParametricQP(**{**plain, "H": H, "c": c})

    def solve_with_multipliers(self, theta: Array) -> tuple[Array | None, Array]:
        """Return the optimal U (v,), or None, and 1 for each active row (rows,), else 0."""
        U, multipliers = self.mild.solve_with_multipliers(theta)
        if U is None:
            return None, multipliers
        start = np.flatnonzero(multipliers > 1e-11 * max(1.0, multipliers.max(initial=0.0)))
        found = self.conditions_at(theta, as_bits(start))
        if found is None:
            return super().solve_with_multipliers(theta)
        active = np.zeros(len(self.w))
        active[list(found.active)] = 1.0
        return found.law @ np.append(theta, 1.0), active

    def conditions_at(self, theta: Array, active: int) -> Optimality | None:
        """Return the KKT conditions that hold at theta, begun from an active set; None: none do."""
        tried: set[int] = set()
        ahead = [active]
        while ahead and len(tried) < MOST_STEPS:
            active = ahead.pop()
            if active in tried:
                continue
            tried.add(active)
            each = self.conditions_of(active)
            if each is None:
                continue
            beyond = each.rows[:, :-1] @ theta - each.rows[:, -1]
            worst = int(np.argmax(beyond)) if len(beyond) else -1
            if worst < 0 or beyond[worst] <= HELD:
                return each
            ahead += reversed(each.across(worst))
        return None

    def conditions_of(self, active: int) -> Optimality | None:
        """Return the KKT conditions of an active set, None where its constraints depend."""
        known = self._known.get(active)
        if known is None and active not in self._known:
            members = tuple(k for k in range(active.bit_length()) if active >> k & 1)
            with suppress(np.linalg.LinAlgError):
                known = optimality(self, [members], everywhere=True)[0]
            if len(self._known) >= MOST_KNOWN:
                self._known.clear()
            self._known[active] = known
        return known

    @cached_property
    def _known(self) -> dict[int, Optimality | None]:
        return {}
