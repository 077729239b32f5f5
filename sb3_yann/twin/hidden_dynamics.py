"""Hidden dynamics: a twin whose next state also depends on the inputs and errors before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.twin.dynamics import Dynamics
from sb3_yann.twin.log import Episode
from sb3_yann.twin.row_layout import RowLayout

LAGS = 2  # earlier samples that count
FOLDS = 5  # parts of a log's episodes, each of which is held out once
LESS = 0.02  # share of the errors of one step that the memory must explain on held-out episodes
ROWS = 4  # steps of a log for each coefficient, at least


@dataclass(frozen=True)
class HiddenDynamics:
    """A member of a twin with a memory, ``x+ = f(x, u) + W [1, x, u, earlier u, earlier errors]``.

    An error is what the member missed a state by. An actuator that lags, backlash and a load that
    lasts show in these terms, an ARMAX model's (Ljung, *System Identification*, section 4.2).

    Attributes
    ----------
    member : Dynamics
        f, of one member.
    weights : ndarray, shape (1 + n + m + LAGS (m + n), n)
    held : bool
        Whether the input before an episode is its first one; else it is zero.
    """

    member: Dynamics
    weights: Array
    held: bool

    @classmethod
    def of(cls, dynamics: Dynamics, episodes: tuple[Episode, ...]) -> HiddenDynamics | None:
        """Return the one of a log; None where memory explains nothing of held-out episodes."""
        member = Dynamics(dynamics.problem, dynamics.coordinates, dynamics.members[:1])
        state, n = dynamics.row.state, dynamics.problem.model.n_states
        plain = 1 + n + dynamics.m
        errors = [
            each.thetas[1:, state]
            - member.step(each.thetas[None, :-1], each.actions[None])[0][:, state]
            for each in episodes
        ]
        steps = sum(map(len, errors))
        if len(episodes) < 2 or steps < ROWS * (plain + LAGS * (dynamics.m + n)):
            return None
        found: list[tuple[Array, Array, bool]] = []
        for held in (False, True):
            rows = [
                _regressors(each.thetas[:-1, state], each.actions, missed, held)
                for each, missed in zip(episodes, errors, strict=True)
            ]
            left = _held_out(rows, errors)
            basis = np.concatenate(rows)
            weights = np.linalg.lstsq(basis, np.concatenate(errors), rcond=1e-9)[0]
            found.append((left, weights, held))
        left, weights, held = min(found, key=lambda each: float(np.sum(np.log(each[0] + 1e-300))))
        without = _held_out([each[:, :plain] for each in rows], errors)
        return cls(member, weights, held) if np.any(left < (1 - LESS) * without) else None

    @property
    def row(self) -> RowLayout:
        """What a row holds."""
        return self.member.row

    def roll_out(
        self, act: Callable[[Array], Array], starts: Array, steps: int, given: Array
    ) -> tuple[Array, Array]:
        """Return rows (steps + 1, 1, batch, size) and inputs (steps, 1, batch, m) of a policy.

        Parameters
        ----------
        act, starts, steps, given : callable, ndarray (1, batch, size), int and ndarray
            As of :meth:`Dynamics.roll_out`.
        """
        batch, m, state = starts.shape[1], self.member.m, self.row.state
        rows, inputs = np.empty((steps + 1, *starts.shape)), np.empty((steps, 1, batch, m))
        rows[0] = starts
        errors = np.zeros((LAGS + steps, batch, starts[..., state].shape[-1]))
        past = np.zeros((LAGS + steps, batch, m))
        for t in range(steps):
            rows[t][..., self.row.given] = given[t]
            u = np.asarray(act(self.row.shown(rows[t, 0])), np.float64).reshape(batch, m)
            inputs[t, 0] = u
            if t == 0 and self.held:
                past[:LAGS] = u
            past[LAGS + t] = u
            before = [past[LAGS + t - lag] for lag in range(1, LAGS + 1)]
            missed = [errors[LAGS + t - lag] for lag in range(1, LAGS + 1)]
            z = np.column_stack([np.ones(batch), rows[t, 0][:, state], u, *before, *missed])
            errors[LAGS + t] = z @ self.weights
            rows[t + 1] = self.member.step(rows[t], inputs[t])
            rows[t + 1, 0][:, state] += errors[LAGS + t]
        return rows, inputs


def _regressors(x: Array, u: Array, missed: Array, held: bool) -> Array:
    """Return the terms (T, k) of each step of an episode, from x (T, n), u (T, m) and errors."""
    past = np.vstack([np.tile(u[:1] if held else 0 * u[:1], (LAGS, 1)), u])
    errors = np.vstack([np.zeros((LAGS, missed.shape[1])), missed])
    steps = len(u)
    before = [past[LAGS - lag : LAGS - lag + steps] for lag in range(1, LAGS + 1)]
    earlier = [errors[LAGS - lag : LAGS - lag + steps] for lag in range(1, LAGS + 1)]
    return np.column_stack([np.ones(steps), x, u, *before, *earlier])


def _held_out(rows: list[Array], errors: list[Array]) -> Array:
    """Return summed squares (n,) of what is left of episodes that a fit has not seen."""
    count, squares = min(FOLDS, len(rows)), np.zeros(errors[0].shape[1])
    for k in range(count):
        kept = [i for i in range(len(rows)) if i % count != k]
        basis = np.concatenate([rows[i] for i in kept])
        target = np.concatenate([errors[i] for i in kept])
        weights = np.linalg.lstsq(basis, target, rcond=1e-9)[0]
        for i in range(k, len(rows), count):
            squares += np.sum((errors[i] - rows[i] @ weights) ** 2, axis=0)
    return np.asarray(squares)
