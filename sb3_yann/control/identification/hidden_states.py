"""Hidden states: what earlier states and inputs explain of a linear fit's residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control.identification.curvature import SHARE, features, without
from sb3_yann.control.identification.logs import Episode

NOISE = 0.4  # share of the errors that is left of them at least where they are sensor noise
ENOUGH = 2000  # steps in which hidden states are looked for
FOLDS = 5  # parts of the log, each of which is held out once
ORDERS = (1, 2, 4, 6)
"""Numbers of earlier samples, each tried with one more hidden state in mind than the one before."""


class Leftover(NamedTuple):
    """Mean squares (n,) of what each set of regressors leaves of held-out rows.

    All of them hold the present states and inputs. A log that is too short has zeros throughout:
    nothing can be told then.

    Attributes
    ----------
    linear, squares, lags, both : ndarray, shape (n,)
        With nothing else; with squares and products; with earlier states and inputs; with both.
    late : ndarray, shape (n,)
        With squares, products and the inputs of the dead time, but no earlier states.
    """

    linear: Array
    squares: Array
    lags: Array
    both: Array
    late: Array

    @property
    def remembers(self) -> NDArray[np.bool_]:
        """Whether earlier states and inputs explain a part of the residuals."""
        return np.asarray(self.lags < (1 - SHARE) * self.linear)

    @property
    def bends(self) -> NDArray[np.bool_]:
        """Whether squares and products explain what earlier states and inputs do not."""
        return np.asarray(self.both < (1 - SHARE) * self.lags)

    @property
    def may_bend(self) -> NDArray[np.bool_]:
        """Whether squares and products explain it, or about as much as earlier samples do."""
        some = self.squares < (1 - SHARE) * self.linear
        return np.asarray(self.bends | (some & (self.lags >= NOISE * self.squares)))

    @property
    def is_hidden(self) -> bool:
        """Whether earlier samples explain far more than squares, products and dead time do.

        A filter of the readings takes up to a half off the noise that a sensor adds to the errors
        of one step, and more is a state that is not measured. Where squares and products show
        curvature, earlier samples extrapolate what is left of it, and nothing can be told.
        """
        far_less = np.minimum(self.both, self.lags) < NOISE * self.late
        return bool(np.any(far_less & ~self.bends))


def leftover(episodes: list[Episode], delays: Sequence[int] = ()) -> Leftover:
    """Return what is left of rows that a fit has not seen, part after part of the log.

    The rows of a log depend on their neighbors, which an F test does not know: by chance, slow
    inputs square to what a hidden state adds. A part of the log that was held out tells them apart.

    Parameters
    ----------
    episodes : list of Episode
        The first `ENOUGH` steps count.
    delays : sequence of int, optional
        Dead time of each input.
    """
    n, lags = episodes[0].states.shape[1], max(ORDERS[-1], *delays, 0)
    longer = [episode for episode in episodes if len(episode) > lags]
    steps, none = sum(len(episode) - lags for episode in longer), np.zeros(n)
    width = episodes[0].regressors.shape[1]
    if steps <= 4 * (2 * width + sum(delays) + 1):
        return Leftover(none, none, none, none, none)
    now = np.concatenate([each.regressors[lags:] for each in longer])[:ENOUGH]
    target = np.concatenate([each.states[lags + 1 :] for each in longer])[:ENOUGH]
    past = [
        np.concatenate([each.regressors[lags - lag : len(each) - lag] for each in longer])[:ENOUGH]
        for lag in range(1, lags + 1)
    ]
    steps = len(now)
    center = now.mean(axis=0)
    plain = np.column_stack([np.ones(steps), now - center])
    target_left = without(plain, target)
    # Below it, all is rounding.
    floor = 1e-9 * np.mean(target_left**2, axis=0) + 1e-20 * np.mean(target**2, axis=0)
    floor += np.finfo(float).tiny
    parts = np.array_split(np.arange(steps), FOLDS)

    def left(*groups: Array) -> Array:
        return np.asarray(_held_out(np.column_stack([plain, *groups]), target_left, parts) + floor)

    squares = features(now - center)
    lagged = [
        np.column_stack([each - center for each in past[:order]])
        for order in ORDERS
        if steps > 4 * width * (order + 1)
    ]
    each_order = [left(each) for each in lagged]
    best = int(np.argmin([np.sum(np.log(each)) for each in each_order]))
    on_their_way = [past[lag][:, n + j] for j, delay in enumerate(delays) for lag in range(delay)]
    late = left(squares, *on_their_way)
    both = left(squares, lagged[best])
    return Leftover(left(), left(squares), each_order[best], both, late)


def _held_out(basis: Array, values: Array, parts: list[NDArray[np.int64]]) -> Array:
    """Return mean squared errors (n,) of a least-squares fit, each part left out once."""
    scale = np.linalg.norm(basis, axis=0)
    basis, squares = basis / np.where(scale > 0, scale, 1.0), np.zeros(values.shape[1])
    for part in parts:
        fitted = np.delete(basis, part, axis=0), np.delete(values, part, axis=0)
        coefficients = np.linalg.lstsq(*fitted, rcond=1e-11)[0]
        squares += np.sum((values[part] - basis[part] @ coefficients) ** 2, axis=0)
    return np.asarray(squares / len(values))
