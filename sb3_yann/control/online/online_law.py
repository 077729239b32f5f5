"""The law of a linear MPC whose program is solved at each point."""

from __future__ import annotations

import copy
from dataclasses import dataclass, fields
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann import _validation as check
from sb3_yann._archive import write_arrays
from sb3_yann._validation import Array, check_array, half_widths
from sb3_yann.control.explicit.parametric_qp import ParametricQP, as_bits
from sb3_yann.control.explicit.steep import SteepQP
from sb3_yann.control.law._files import read_law
from sb3_yann.control.law.on_plant import OnPlant, plant_arrays, with_plant
from sb3_yann.control.law.piecewise_affine import INFEASIBLE, as_points
from sb3_yann.control.online.dual_program import (
    Answers,
    DualProgram,
    scaled_program,
)
from sb3_yann.control.online.known_points import KnownPoints

if TYPE_CHECKING:
    from sb3_yann._numba import Integers

_KEPT = ("dual", "known", "program", "scaled", "half")


@dataclass(frozen=True, eq=False)
class OnlineLaw(OnPlant):
    """The first input of a condensed program, which is solved at each theta; total and bounded.

    A compiled dual active-set method solves it, and an answer counts where all optimality
    conditions hold. Else DAQP is asked. The answer depends on theta alone, not on what was asked
    before. Answers are kept: the same theta is not solved again.

    Where the program has no solution, ``infeasible`` decides:

    - ``"nearest_region"``: all constraints but those of single inputs give way as little as
      possible, at a large cost of the squares of their violations. So far from the box that
      float64 cannot solve this either, the inputs that nothing constrains are clipped.
    - ``"zero_input"``: no deviation of the input, clipped to the bounds.

    Other than :class:`PiecewiseAffine`, it does not end at the box of theta.

    Attributes
    ----------
    H, F, c, G, w, S : ndarray
        As in :class:`ParametricQP`.
    u_min, u_max : ndarray, shape (m,)
        Bounds of the input, infinite where there is none.
    theta_min, theta_max : ndarray, shape (n,)
        The box of theta; a network scales its inputs by it.
    n_slacks, n_input_rows, feedback
        Likewise.
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

    def __post_init__(self) -> None:
        """Check the arrays against each other and store them as read-only float64."""
        F, G = check_array("F", self.F, ("v", "n")), check_array("G", self.G, ("rows", len(self.F)))
        (v, n), rows = F.shape, len(G)
        shapes: dict[str, tuple[int, ...]] = {"H": (v, v), "c": (v,), "w": (rows,), "S": (rows, n)}
        values = {
            name: check_array(name, getattr(self, name), size) for name, size in shapes.items()
        }
        m = np.size(self.u_min)
        for name, size in (("u", m), ("theta", n)):
            low, high = f"{name}_min", f"{name}_max"
            bounds = check.check_bounds(name, getattr(self, low), getattr(self, high), size)
            values[low], values[high] = bounds
        check.check_choice("infeasible", self.infeasible, INFEASIBLE)
        slacks = check.check_int("n_slacks", self.n_slacks, 0)
        check.check_int("n_input_rows", self.n_input_rows, 0)
        if m == 0 or (v - slacks) % m or v == slacks:
            raise ValueError(
                f"The program has {v} variables, {slacks} of them slacks: the others must be the "
                f"{m} inputs of each step."
            )
        feedback = np.zeros((m, n)) if self.feedback is None else self.feedback
        values["feedback"] = check_array("feedback", feedback, (m, n))
        _require_positive_definite(values["H"])
        self._store(F=F, G=G, **values)

    @classmethod
    def of(cls, program: ParametricQP, u_min: Array, u_max: Array, infeasible: str) -> OnlineLaw:
        """Return the law of a program.

        Parameters
        ----------
        program : ParametricQP
            Whose first variables are the inputs.
        u_min, u_max, infeasible
            As in :class:`OnlineLaw`.
        """
        parts = {field.name: getattr(program, field.name) for field in fields(program)}
        return cls(**parts, u_min=u_min, u_max=u_max, infeasible=infeasible)

    @property
    def n_theta(self) -> int:
        """Number of parameters n."""
        return int(self.F.shape[1])

    @property
    def n_inputs(self) -> int:
        """Number of inputs m."""
        return len(self.u_min)

    @property
    def n_constraints(self) -> int:
        """Number of constraints of the program; it has no regions that could be counted."""
        return len(self.w)

    def __call__(self, theta: ArrayLike) -> Array:
        """Return the input: (m,) for theta of shape (n,), (batch, m) for (batch, n)."""
        points, rows = as_points(theta, self.n_theta)
        inputs = self.known(rows)
        return inputs if points.ndim == 2 else inputs[0]

    def in_domain(self, theta: ArrayLike) -> NDArray[np.bool_]:
        """Tell whether the MPC has a solution at theta, for each row of a batch."""
        points, rows = as_points(theta, self.n_theta)
        return self._answers(rows)[1].reshape(points.shape[:-1])

    def gain(self, theta: ArrayLike) -> Array:
        """Return the derivative of the input by theta, (m, n) at (n,) or (batch, m, n).

        It is that of the constraints which are active at theta, before bounds clip the input.
        """
        points, rows = as_points(theta, self.n_theta)
        _, feasible, found, softened = self._answers(rows)
        gains = np.empty((len(rows), self.n_inputs, self.n_theta))
        place = np.cumsum(~feasible) - 1
        for i, solved in enumerate(feasible):
            if not solved and softened is None:
                gains[i] = 0.0
                continue
            own, at = (found, i) if solved or softened is None else (softened, place[i])
            active = own.active[at, : own.sizes[at]]
            exact = self._exact_gain(active) if solved else None
            gains[i] = self.dual.gain(active, soft=not solved) if exact is None else exact
        return gains if points.ndim == 2 else gains[0]

    def save(self, path: str | PathLike[str]) -> None:
        """Write the program to ``path`` as an ``.npz`` file of plain arrays, with its plant."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        write_arrays(path, arrays | plant_arrays(self))

    @classmethod
    def load(cls, path: str | PathLike[str]) -> OnlineLaw:
        """Read a law that :meth:`save` wrote, to the bit; nothing of the file is executed.

        OSError if the file cannot be read; ValueError if it holds no law, was changed since it was
        written, or is of before files had digests.
        """
        return read_law("an OnlineLaw", path, cls._from_arrays)

    @classmethod
    def _from_arrays(cls, data: dict[str, Any]) -> OnlineLaw:
        data = {"n_input_rows": 0, "feedback": None, **data}  # which older files lack
        values = {field.name: data[field.name] for field in fields(cls)}
        for name, kind in (("infeasible", str), ("n_slacks", int), ("n_input_rows", int)):
            values[name] = kind(values[name])
        return with_plant(cls(**values), data)

    @cached_property
    def program(self) -> ParametricQP:
        """The condensed program, in the units of the plant."""
        values = {each.name: getattr(self, each.name) for each in fields(ParametricQP)}
        # copies: DAQP takes no arrays that are read-only
        return ParametricQP(**{name: copy.copy(value) for name, value in values.items()})

    @cached_property
    def dual(self) -> DualProgram:
        """The program as it is solved."""
        return DualProgram.of(self.program, self.u_min, self.u_max)

    @cached_property
    def scaled(self) -> tuple[ParametricQP, Array]:
        """The program in units of the input range and theta's box, and those of U (v,)."""
        return scaled_program(self.program, self.u_min, self.u_max)

    @cached_property
    def half(self) -> Array:
        """The half-widths of theta's box."""
        return half_widths(self.theta_min, self.theta_max)

    @cached_property
    def known(self) -> KnownPoints:
        """The law as a function of contiguous rows (batch, n), with what it remembers."""
        return KnownPoints(lambda rows: self._answers(rows)[0], self.n_inputs)

    def _answers(self, rows: Array) -> tuple[Array, NDArray[np.bool_], Answers, Answers | None]:
        """Return inputs, what is feasible, the answers, and those of infeasible rows softened."""
        from sb3_yann.control.online import _kernels

        with np.errstate(over="ignore", invalid="ignore"):
            found = self.dual.solve(rows)
        u, feasible = self.dual.inputs(rows, found), found.status == _kernels.SOLVED
        settled = not (len(self.dual.fixed[1]) or self.scaled[0].steep)
        if settled and feasible.all():  # mostly: the rest takes microseconds
            return u, feasible, found, None
        asked = found.status == _kernels.UNKNOWN
        if self.scaled[0].steep:
            asked |= feasible  # of a milder program
        for i in np.flatnonzero(asked):
            feasible[i] = self._ask_daqp(rows[i], u[i], found, i)
        feasible &= self.dual.meets_fixed(rows)
        softened, lost = None, np.flatnonzero(~feasible)
        if len(lost) and self.infeasible == "zero_input":
            u[lost] = 0.0
        elif len(lost):
            again = np.ascontiguousarray(rows[lost])
            softened = self.dual.solve(again, soft=True)
            u[lost] = self.dual.soft_inputs(again, softened)
        u = np.nan_to_num(u, nan=0.0)  # inf - inf, far from everything
        return np.clip(u, self.u_min, self.u_max), feasible, found, softened

    def _ask_daqp(self, theta: Array, u: Array, found: Answers, at: int) -> bool:
        """Write the input and active set where the compiled method has no certificate."""
        (scaled, reach), place = self.scaled, theta / self.half
        start = self.dual.rows[found.active[at, : found.sizes[at]]]
        each = scaled.conditions_at(place, as_bits(start)) if isinstance(scaled, SteepQP) else None
        if each is not None:
            U, tight = each.law @ np.append(place, 1.0), np.isin(self.dual.rows, each.active)
        else:
            answer, multipliers = scaled.solve_with_multipliers(place)
            if answer is None:
                return False
            U, tight = answer, multipliers[self.dual.rows] > 0
        active = np.flatnonzero(tight)[: found.active.shape[1]]
        found.sizes[at], found.active[at, : len(active)] = len(active), active
        u[:] = self.program.first_input(reach * U, theta, len(u))
        return True

    def _exact_gain(self, active: Integers) -> Array | None:
        """Return the gain of an active set of a steep program, None of others."""
        scaled, reach = self.scaled
        if not isinstance(scaled, SteepQP):
            return None
        found = scaled.conditions_of(as_bits(self.dual.rows[active]))
        m = self.n_inputs
        if found is None:
            return None
        feedback = np.asarray(self.feedback, np.float64)
        return np.asarray(reach[:m, None] * found.law[:m, :-1] / self.half + feedback)

    def __hash__(self) -> int:
        """Return a hash that equal laws share."""
        return hash((self.H.tobytes(), self.F.tobytes(), self.infeasible))

    def __repr__(self) -> str:
        """Name the sizes."""
        sizes = f"constraints={self.n_constraints}, variables={len(self.c)}, theta={self.n_theta}"
        return f"OnlineLaw({sizes}, inputs={self.n_inputs}, infeasible={self.infeasible!r})"

    def __deepcopy__(self, memo: object = None) -> OnlineLaw:
        """Return the law itself: nothing of it can change."""
        return self

    __copy__ = __deepcopy__

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what follows from the rest, and what is remembered."""
        return {name: each for name, each in vars(self).items() if name not in _KEPT}


def _require_positive_definite(H: Array) -> None:
    scale = np.sqrt(np.abs(np.diag(H)))  # in units in which all variables count alike
    unit = H / np.maximum(np.outer(scale, scale), 1e-300)
    apart = np.abs(unit - unit.T)
    i, j = np.unravel_index(np.argmax(apart), apart.shape)
    fault = "" if apart[i, j] < 1e-9 else f"H[{i}, {j}] = {H[i, j]:g}, H[{j}, {i}] = {H[j, i]:g}"
    try:
        np.linalg.cholesky(unit)
    except np.linalg.LinAlgError:
        fault = fault or f"its smallest eigenvalue is {np.linalg.eigvalsh(H)[0]:.3g}"
    if fault:
        raise ValueError(
            f"H must be symmetric and positive definite ({fault}): else the program has no unique "
            "solution."
        )
