"""The law of a linear MPC whose program is solved at each point."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from sb3_yann._validation import Array, check_array, check_choice, check_int, half_widths, warn
from sb3_yann.control import lqr
from sb3_yann.control.explicit.parametric_qp import ParametricQP, moderated, slack_costs
from sb3_yann.control.law import INFEASIBLE_OPTIONS, PiecewiseAffine, PlantLaw, bounds_of

if TYPE_CHECKING:
    from sb3_yann._numba import Integers


class OnlineLawWarning(UserWarning):
    """A problem has no explicit law within the budget, and its program is solved online instead.

    Examples
    --------
    >>> issubclass(OnlineLawWarning, UserWarning)
    True
    """


@dataclass(frozen=True, eq=False)
class OnlineLaw(PlantLaw):
    """The first input of a condensed program, which is solved at each theta; total and bounded.

    A compiled dual active-set method solves it, and an answer counts where all optimality
    conditions hold. Else DAQP is asked. The answer depends on theta alone, not on what was asked
    before. Answers are kept: the same theta is not solved again.

    Where the program has no solution, ``infeasible`` decides:

    - ``"nearest_region"``: all constraints but those of single inputs give way as little as
      possible, at a large cost of the squares of their violations. So far from the box that
      float64 cannot solve this either, the inputs that nothing constrains are clipped.
    - ``"zero_input"``: no deviation of the input, clipped to the bounds.

    Other than :class:`PiecewiseAffine`, it does not end at the box of states.

    Attributes
    ----------
    H, F, c, G, w, S, n_slacks, n_input_rows, feedback
        As in :class:`ParametricQP`.
    u_min, u_max : ndarray, shape (m,)
        Bounds of the input, infinite where there is none.
    theta_min, theta_max : ndarray, shape (n,)
        The box of theta; a network scales its inputs by it.
    infeasible : {"nearest_region", "zero_input"}, default "nearest_region"

    Examples
    --------
    >>> one = np.ones((1, 1))
    >>> law = OnlineLaw(
    ...     H=one, F=2 * one, c=[0.0], G=[[1.0], [-1.0]], w=[1.0, 1.0], S=[[0.0], [0.0]],
    ...     u_min=[-1.0], u_max=[1.0], theta_min=[-1.0], theta_max=[1.0],
    ... )
    >>> law([0.25]), law([[3.0], [-0.25]]).tolist()
    (array([-0.5]), [[-1.0], [0.5]])
    """

    H: Array
    F: Array
    c: Array
    G: Array
    w: Array
    S: Array
    u_min: Array
    u_max: Array
    theta_min: Array
    theta_max: Array
    n_slacks: int = 0
    infeasible: str = "nearest_region"
    n_input_rows: int = 0
    feedback: Array | None = None
    _kind = "an OnlineLaw"
    _derived = ("dual", "known", "program", "scaled", "_first_rows", "_has_warned")

    def __post_init__(self) -> None:
        F = check_array("F", self.F, ("v", "n"))
        v, n = F.shape
        G = check_array("G", self.G, ("rows", v))
        m = np.size(self.u_min)
        values = {
            "F": F,
            "G": G,
            "H": check_array("H", self.H, (v, v)),
            "c": check_array("c", self.c, (v,)),
            "w": check_array("w", self.w, (len(G),)),
            "S": check_array("S", self.S, (len(G), n)),
            **bounds_of(self, m, n),
        }
        check_choice("infeasible", self.infeasible, INFEASIBLE_OPTIONS)
        slacks = check_int("n_slacks", self.n_slacks, 0)
        check_int("n_input_rows", self.n_input_rows, 0)
        if m == 0 or (v - slacks) % m or v == slacks:
            raise ValueError(
                f"The program has {v} variables, {slacks} of them slacks: the others must be the "
                f"{m} inputs of each step."
            )
        feedback = np.zeros((m, n)) if self.feedback is None else self.feedback
        values["feedback"] = check_array("feedback", feedback, (m, n))
        _require_positive_definite(values["H"])
        self._store(**values)

    @classmethod
    def of(cls, program: ParametricQP, u_min: Array, u_max: Array, infeasible: str) -> OnlineLaw:
        """Return the law of a program whose first variables are the inputs.

        Parameters
        ----------
        program, u_min, u_max, infeasible
            As in :class:`OnlineLaw`.
        """
        parts = {each.name: getattr(program, each.name) for each in fields(program)}
        return cls(**parts, u_min=u_min, u_max=u_max, infeasible=infeasible)

    @property
    def n_constraints(self) -> int:
        """Number of constraints of the program; it has no regions that could be counted."""
        return len(self.w)

    def __call__(self, theta: ArrayLike) -> Array:
        """Return the input: (m,) for theta of shape (n,), (batch, m) for (batch, n)."""
        points, rows = self._points(theta)
        inputs = self.known(rows)
        return inputs if points.ndim == 2 else inputs[0]

    def in_domain(self, theta: ArrayLike) -> NDArray[np.bool_]:
        """Tell whether the MPC has a solution at theta, in deviations, for each row of a batch."""
        points, rows = self._points(theta)
        return self._answers(rows)[1].reshape(points.shape[:-1])

    def gain(self, theta: ArrayLike) -> Array:
        """Return the derivative of the input by theta, (m, n) at (n,) or (batch, m, n).

        It is that of the constraints which are active at theta, before bounds clip the input.
        """
        points, rows = self._points(theta)
        _, feasible, found, softened = self._answers(rows)
        gains = np.zeros((len(rows), self.n_inputs, self.n_theta))
        for i in np.flatnonzero(feasible):
            gains[i] = self.dual.gain(found.active[i, : found.sizes[i]])
        if softened is not None:
            for k, i in enumerate(np.flatnonzero(~feasible)):
                gains[i] = self.dual.gain(softened.active[k, : softened.sizes[k]], soft=True)
        return gains if points.ndim == 2 else gains[0]

    @cached_property
    def program(self) -> ParametricQP:
        """The condensed program, in the units of the plant."""
        values = {each.name: getattr(self, each.name) for each in fields(ParametricQP)}
        # Copies: DAQP takes no arrays that are read-only.
        return ParametricQP(**{name: copy.copy(value) for name, value in values.items()})

    @cached_property
    def dual(self) -> DualProgram:
        """The program as it is solved."""
        return DualProgram.of(self.program, *self.scaled, self.u_min, self.u_max)

    @cached_property
    def scaled(self) -> tuple[ParametricQP, Array]:
        """The program in half-widths of the input range and theta's box, and those of U (v,)."""
        scaled, reach = self.program.scaled(self.u_min, self.u_max, np.zeros(self.n_theta))
        return moderated(scaled), reach

    @cached_property
    def known(self) -> KnownPoints:
        """The law as a function of contiguous rows (batch, n), with what it remembers."""
        return KnownPoints(self._inputs, self.n_inputs)

    def _inputs(self, rows: Array) -> Array:
        """Return the inputs (batch, m) at rows of theta, and warn where rounding hides the law."""
        u, feasible, _, _ = self._answers(rows)
        if self.n_slacks and not feasible.all():
            self._warn_beyond_reach(rows[~feasible])
        return u

    def _warn_beyond_reach(self, rows: Array) -> None:
        """Warn once of rows in the box where soft bounds give way, but no answer is certain."""
        inside = np.all((rows >= self.theta_min) & (rows <= self.theta_max), axis=1)
        if self.model is None or not inside.any() or "_has_warned" in vars(self):
            return
        inputs = len(self.c) - self.n_slacks
        hard = ~np.any(self.G[:, inputs:], axis=1) & np.any(self.S, axis=1)
        place = f"no solution was found at theta = {rows[inside][0].tolist()}"
        bounded = "The input is bounded, but not the MPC's; law.in_domain is False."
        if np.any(np.asarray(self.feedback)):
            words = (
                f"{lqr.long_horizon(self.model.A, inputs // self.n_inputs)}, {place}: no input "
                "brings the model back from there, or a hard bound cannot be kept. Predictions run "
                f"away, and rounding hides the law. {bounded} Give theta_min and theta_max the "
                "states from which inputs bring it back, or pass a shorter horizon."
            )
        elif hard.any():
            return
        else:
            words = (
                f"All bounds but the inputs' are soft, and {place}: they cost more than the digits "
                f"of float64 hold. {bounded} Lower SoftBounds(penalty=), or give units that differ "
                "less."
            )
        vars(self)["_has_warned"] = True
        warn(words)

    def _answers(self, rows: Array) -> tuple[Array, NDArray[np.bool_], Answers, Answers | None]:
        """Return inputs, what is feasible, the answers, and those of infeasible rows softened."""
        from sb3_yann.control._kernels import online as kernels

        with np.errstate(over="ignore", invalid="ignore"):
            found = self.dual.solve(rows)
        u = self.dual.inputs(rows, found)
        feasible = found.status == kernels.SOLVED
        if feasible.all() and not len(self.dual.fixed[1]):
            return u, feasible, found, None  # mostly: the rest takes microseconds
        for i in np.flatnonzero(found.status == kernels.UNCERTIFIED):
            feasible[i] = self._ask_daqp(rows[i], u[i], found, i)
        S, w = self.dual.fixed
        feasible &= np.all(rows @ S.T + w >= -1e-11, axis=1)
        softened = None
        outside = np.flatnonzero(~feasible)
        if len(outside) and self.infeasible == "zero_input":
            u[outside] = 0.0
        elif len(outside):
            again = np.ascontiguousarray(rows[outside])
            softened = self.dual.solve(again, soft=True)
            u[outside] = self.dual.inputs(again, softened)
        u = np.clip(np.nan_to_num(u, nan=0.0), self.u_min, self.u_max)  # inf - inf, far away
        # A solution keeps them by itself: whatever else is in the batch, its bits stay.
        u[outside] = self._within_range(u[outside], rows[outside])
        return u, feasible, found, softened

    def _ask_daqp(self, theta: Array, u: Array, found: Answers, at: int) -> bool:
        """Write the input and active set where the compiled method has no certificate."""
        program, reach = self.scaled
        half = half_widths(self.theta_min, self.theta_max)
        U, multipliers = program.solve_with_multipliers(theta / half)
        if U is None:
            return False
        members = np.flatnonzero(multipliers[self.dual.rows] > 0)
        members = members[: found.active.shape[1]]
        found.sizes[at] = len(members)
        found.active[at, : len(members)] = members
        u[:] = self.program.first_input(reach * U, theta, len(u))
        # Where an unstable model runs away U is huge, and the sum has few digits left.
        for bound, first in zip((self.u_max, self.u_min), self._first_rows, strict=True):
            np.copyto(u, bound, where=np.isin(first, self.dual.rows[members]))
        return True

    @cached_property
    def _first_rows(self) -> Integers:
        """Rows (2, m) of the upper and lower bounds of the first inputs; -1 where there is none."""
        finite = np.isfinite([self.u_max, self.u_min])
        steps = (len(self.c) - self.n_slacks) // self.n_inputs
        before = steps * np.array([[0], [finite[0].sum()]])
        known = finite & (self.n_input_rows == steps * finite.sum())
        rows = np.where(known, before + np.cumsum(finite, axis=1) - 1, -1)
        K = np.asarray(self.feedback)
        still = [np.all(self.S[row] == S, axis=1) for row, S in zip(rows, (-K, K), strict=True)]
        return np.where(still, rows, -1)  # not those that change at run time

    def __hash__(self) -> int:
        return hash((self.H.tobytes(), self.F.tobytes(), self.infeasible))

    def __repr__(self) -> str:
        sizes = f"constraints={self.n_constraints}, variables={len(self.c)}, theta={self.n_theta}"
        return f"OnlineLaw({sizes}, inputs={self.n_inputs}, infeasible={self.infeasible!r})"


Law = PiecewiseAffine | OnlineLaw
LAWS = ("auto", "explicit", "online")


@dataclass(frozen=True, eq=False)
class Answers:
    """What comes of rows of theta: multipliers and active constraints (batch, most), how many are.

    The status (batch,) is one of `_kernels.online`.
    """

    multipliers: Array
    active: Integers
    sizes: Integers
    status: Integers


@dataclass(frozen=True, eq=False)
class DualProgram:
    """A program in its dual form, in which each point costs no factorization of its own.

    Slacks are ``s = d0 + D' theta + gram lam``, of the constraints that inputs can meet, in units
    in which ``gram`` (rows, rows) has ones on its diagonal. Inputs, in the units of the plant, are
    ``u = k0 + K theta - E' lam``. ``softness`` (rows,) is added to the diagonal where constraints
    are to give way. Of ``fixed``, S and w, no input can change ``S theta + w >= 0``. ``bounds``
    (2, m) are those of the inputs, and ``rows`` is where the constraints lie in the program.
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
    def of(
        cls, program: ParametricQP, scaled: ParametricQP, reach: Array, u_min: Array, u_max: Array
    ) -> DualProgram:
        """Return the dual form of a program, see `OnlineLaw.scaled`, whose first U are inputs."""
        half = half_widths(program.theta_min, program.theta_max)
        # Rows are of unit length in these units; theta itself comes in those of the plant.
        scaled = replace(scaled, F=scaled.F / half, S=scaled.S / half)
        m = len(u_min)
        G = scaled.G
        factor = linalg.cho_factor(scaled.H)
        by_theta = linalg.cho_solve(factor, scaled.F)
        by_one = linalg.cho_solve(factor, scaled.c[:, None])
        by_row = linalg.cho_solve(factor, G.T)
        size = np.sqrt(np.maximum(np.sum(G * by_row.T, axis=1), 0.0))
        # Not by size: with a discount of 0.5 that of step 80 is 1e12 times as large as the first's.
        moved = (np.linalg.norm(G, axis=1) > 1e-12) & (size > 0)
        own = size[moved, None]
        gram = (G @ by_row)[np.ix_(moved, moved)] / (own * own.T)
        np.fill_diagonal(gram, 1.0)
        K = -reach[:m, None] * by_theta[:m]
        if program.feedback is not None:
            K = K + program.feedback
        # A violation costs 1e6 times its square, in units of the curvature of the cost. So much
        # at least is added to the unit diagonal that this can be solved to nine digits.
        softness = np.maximum(1 / (1e6 * own[:, 0] ** 2), 1e-8)
        # Bounds of one input, and what has a slack already, never give way.
        alone = (np.count_nonzero(program.G, axis=1) == 1) & ~np.any(program.S, axis=1)
        alone[: program.n_input_rows] = True
        alone |= np.any(program.G[:, len(program.c) - program.n_slacks :], axis=1)
        return cls(
            D=np.ascontiguousarray(((scaled.S + G @ by_theta)[moved] / own).T),
            d0=(scaled.w + (G @ by_one)[:, 0])[moved] / own[:, 0],
            gram=np.ascontiguousarray(gram),
            E=np.ascontiguousarray((reach[:m, None] * by_row[:m, moved] / own[:, 0]).T),
            K=np.ascontiguousarray(K),
            k0=-reach[:m] * by_one[:m, 0],
            softness=np.where(alone[moved], 0.0, softness),
            fixed=(scaled.S[~moved], scaled.w[~moved]),
            bounds=np.stack([u_min, u_max]),
            rows=np.flatnonzero(moved),
            n_variables=len(reach),
        )

    def solve(self, theta: Array, soft: bool = False) -> Answers:
        """Return what comes of rows (batch, n); where ``soft``, constraints give way."""
        from sb3_yann.control._kernels.online import SOLVED, solve_batch

        rows = len(self.d0)
        most = max(1, rows if soft else min(rows, self.n_variables))
        extra = self.softness if soft else np.zeros(rows)
        found = Answers(
            np.zeros((len(theta), most)),
            np.zeros((len(theta), most), np.int64),
            np.zeros(len(theta), np.int64),
            np.zeros(len(theta), np.int64),
        )
        solve_batch(theta, self.D, self.d0, self.gram, extra, most, *vars(found).values())
        if soft:  # bounds of inputs never give way, and may contradict each other
            found.sizes[found.status != SOLVED] = 0
        return found

    def inputs(self, theta: Array, found: Answers) -> Array:
        """Return the inputs (batch, m), between their bounds."""
        from sb3_yann.control._kernels.online import inputs_of_batch

        u = np.empty((len(theta), len(self.k0)))
        solution = found.multipliers, found.active, found.sizes
        inputs_of_batch(theta, self.K, self.k0, self.E, *solution, self.bounds, u)
        return u

    def gain(self, active: Integers, soft: bool = False) -> Array:
        """Return the derivative (m, n) of the inputs by theta for an active set."""
        inner = self.gram[np.ix_(active, active)]
        if soft:
            inner = inner + np.diag(self.softness[active])
        return np.asarray(self.K + self.E[active].T @ linalg.solve(inner, self.D[:, active].T))


class KnownPoints:
    """A function of rows that remembers them: a row of the same bits is not computed again.

    Two keys of 64 bits stand for a row, so that two rows of a million share them with a chance of
    1e-26. A table that is full, of 2**20 places or some 40 MB for three inputs, forgets.
    """

    def __init__(
        self, function: Callable[[Array], Array], n_outputs: int, size: int = 1 << 20
    ) -> None:
        self.function = function
        # Memory that was never written to is not in use: zeros cost nothing before.
        self._keys = np.zeros((size, 2), np.int64)
        self._values = np.zeros((size, n_outputs))
        self._lock = Lock()  # compiled code runs without Python's

    def __call__(self, rows: Array) -> Array:
        """Return the outputs (batch, n_outputs) for rows (batch, n), contiguous float64."""
        from sb3_yann.control._kernels.online import recall, remember

        u = np.empty((len(rows), self._values.shape[1]))
        missing = np.empty(len(rows), np.int64)
        bits = rows.view(np.int64)
        with self._lock:
            count = recall(bits, self._keys, self._values, u, missing)
        if count:
            new = missing[:count]
            u[new] = self.function(np.ascontiguousarray(rows[new]))
            with self._lock:
                remember(bits, self._keys, self._values, u, new)
        return u


def steepness(program: ParametricQP, u_min: Array, u_max: Array) -> float:
    """Return how many times as much as by a default penalty the slacks of a program cost."""
    scaled, _ = program.scaled(u_min, u_max, 0 * program.theta_min)
    ratio, _ = slack_costs(scaled)
    # By a default penalty a slack costs at most 5e6 times the inputs' own cost.
    return float(ratio.max()) / 5e6


def _require_positive_definite(H: Array) -> None:
    scale = np.sqrt(np.abs(np.diag(H)))  # in units in which all variables count alike
    unit = H / np.maximum(np.outer(scale, scale), 1e-300)
    asymmetry = np.abs(unit - unit.T)
    i, j = np.unravel_index(np.argmax(asymmetry), asymmetry.shape)
    fault = ""
    if asymmetry[i, j] >= 1e-9:
        fault = f"H[{i}, {j}] = {H[i, j]:g}, H[{j}, {i}] = {H[j, i]:g}"
    else:
        try:
            np.linalg.cholesky(unit)
        except np.linalg.LinAlgError:
            fault = f"its smallest eigenvalue is {np.linalg.eigvalsh(H)[0]:.3g}"
    if fault:
        raise ValueError(
            f"H must be symmetric and positive definite ({fault}): else the program has no unique "
            "solution."
        )
