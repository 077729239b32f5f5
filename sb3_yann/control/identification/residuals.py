"""What the residuals of a linear fit hold: curvature, hidden states, noise; and notes on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from sb3_yann._validation import Array
from sb3_yann.control.gains import CURVED, UNTOLD
from sb3_yann.control.identification.innovations import with_lags
from sb3_yann.control.identification.least_squares import (
    WEAK,
    Regression,
    neighbors,
    pole_errors,
    pole_note,
    stacked,
)
from sb3_yann.log import Episode
from sb3_yann.units import FLOAT32_ROUNDING

CURVATURE_SHARE = 0.1


def features(regressors: Array) -> Array:
    """Return squares, products and cubes (k, q) of the main components of regressors (k, p).

    There are as many components as the number of rows allows. The regressors are centered.
    """
    k, p = regressors.shape
    spread = np.sqrt(np.mean(regressors**2, axis=0))
    z = regressors / np.where(spread > 0, spread, 1.0)
    room = k // 4 - p - 1  # steps for each feature, at least: with fewer the features fit anything
    # 12: main components, at most: a long log with many states must not take minutes
    kept = sum((i + 1) * (i + 4) / 2 <= room for i in range(min(p, 12)))
    if not kept:
        return np.zeros((k, 0))
    left, sizes, _ = np.linalg.svd(z, full_matrices=False)
    main = left[:, :kept][:, sizes[:kept] > 1e-6 * sizes[0]] * np.sqrt(k)
    first, second = np.triu_indices(main.shape[1])
    return np.hstack([main[:, first] * main[:, second], main**3])


def curvature_test(found: Regression, episodes: list[Episode]) -> tuple[Array, Array]:
    """Return the share (n,) of each residual's variance that curvature explains, and what is left.

    The shares are corrected for the number of features, and zero where chance explains them. What
    is left has the shape (steps, n).
    """
    regressors, reached = stacked(episodes)
    residuals = reached - found.predict(regressors)
    now = regressors - found.center
    known = np.column_stack([np.ones(len(now)), now])
    added = features(now)
    before = project_out(known, residuals)
    after = project_out(np.column_stack([known, added]), residuals)
    q = added.shape[1]
    free = len(now) - known.shape[1] - q
    size = np.sum(before**2, axis=0)
    rest = np.sum(after**2, axis=0)
    real = size > 1e-20 * np.sum(reached**2, axis=0)
    if not q or free < 1 or not np.any(real):
        return np.zeros(len(size)), residuals
    size = np.where(real, size, 1.0)
    rest = np.where(real, rest, 1.0)
    share = 1 - (rest / free) / (size / (free + q))
    ratio = ((size - rest) / q) / np.maximum(rest / free, np.finfo(float).tiny)
    # 1e-3: the significance from which curvature is named
    sure = real & (np.asarray(fdtrc(q, free, ratio)) < 1e-3)
    return np.asarray(np.where(sure & (share > CURVATURE_SHARE), share, 0.0)), after


TIED = 0.25  # share of an input that a law leaves, above which coarse steps may be a test signal


def within_rounding(known: Array, now: Array) -> NDArray[np.bool_]:
    """Return which columns (N, m) are linear in those (N, k), to within the rounding of all.

    Of a law, rounded readings leave what their rounding adds up to; a test signal is larger.
    """
    law = np.linalg.lstsq(known, now, rcond=None)[0]
    rest = now - known @ law
    fine, coarse = (
        np.array([min(np.diff(np.unique(each)), default=0.0) for each in of.T])
        for of in (now, known)
    )
    grain: Array = np.sqrt((fine**2 + coarse**2 @ law**2) / 12)
    small = np.all(np.abs(rest) < 6 * grain, axis=0) & (np.std(rest, axis=0) < 1.5 * grain)
    return np.asarray(small)


def project_out(basis: Array, values: Array) -> Array:
    """Return what a least-squares fit by the basis leaves of the values."""
    scale = np.linalg.norm(basis, axis=0)
    left, sizes, _ = np.linalg.svd(basis / np.where(scale > 0, scale, 1.0), full_matrices=False)
    left = left[:, sizes > 1e-10 * sizes[0]]
    return np.asarray(values - left @ (left.T @ values))


NOISE_SHARE = 0.4  # share of the errors that is left of them at least where they are sensor noise
SEARCHED = 2000  # steps in which hidden states are looked for
FOLDS = 5  # parts of the log, each of which is held out once
ORDERS = (1, 2, 4, 6)
"""Numbers of earlier samples, each tried with one more hidden state in mind than the one before."""


class Leftover(NamedTuple):
    """Mean squares (n,) of what each set of regressors leaves of held-out rows.

    All of them hold the present states and inputs: with nothing else; with squares and products;
    with earlier states and inputs; with both; with squares, products and the inputs of the dead
    time. A log that is too short has zeros throughout: nothing can be said then.
    """

    linear: Array
    squares: Array
    lags: Array
    both: Array
    late: Array

    @property
    def bends(self) -> NDArray[np.bool_]:
        """Whether squares and products explain what earlier states and inputs do not."""
        return np.asarray(self.both < (1 - CURVATURE_SHARE) * self.lags)

    @property
    def may_bend(self) -> NDArray[np.bool_]:
        """Whether squares and products explain it, or about as much as earlier samples do."""
        some = self.squares < (1 - CURVATURE_SHARE) * self.linear
        return np.asarray(self.bends | (some & (self.lags >= NOISE_SHARE * self.squares)))

    @property
    def is_hidden(self) -> bool:
        """Whether earlier samples explain far more than squares, products and dead time do.

        A filter of the readings takes up to a half off the noise that a sensor adds to the errors
        of one step, and more is a state that is not measured. Where squares and products show
        curvature, earlier samples extrapolate what is left of it, and nothing can be said.
        """
        far_less = np.minimum(self.both, self.lags) < NOISE_SHARE * self.late
        return bool(np.any(far_less & ~self.bends))


def leftover(episodes: list[Episode], delays: Sequence[int] = ()) -> Leftover:
    """Return what is left of rows that a fit has not seen, part after part of the log.

    The rows of a log depend on their neighbors, which an F test does not know: by chance, slow
    inputs square to what a hidden state adds. A part of the log that was held out separates them.
    The first `SEARCHED` steps count. ``delays`` are the dead times of the inputs.
    """
    n = episodes[0].states.shape[1]
    lags = max(ORDERS[-1], *delays, 0)
    rows = with_lags(episodes, lags + 1, lags)
    width = episodes[0].regressors.shape[1]
    if sum(map(len, rows)) <= 4 * (2 * width + sum(delays) + 1):
        return Leftover(*[np.zeros(n)] * 5)
    known, target = (each[:SEARCHED] for each in stacked(rows))
    now, *past = np.split(known, lags + 1, axis=1)
    steps = len(now)
    center = now.mean(axis=0)
    plain = np.column_stack([np.ones(steps), now - center])
    target_left = project_out(plain, target)
    # Below it, all is rounding.
    floor = 1e-9 * np.mean(target_left**2, axis=0) + 1e-20 * np.mean(target**2, axis=0)
    floor += np.finfo(float).tiny

    def left(*groups: Array) -> Array:
        """Return mean squared errors (n,) of a least-squares fit, each part left out once."""
        basis = np.column_stack([plain, *groups])
        scale = np.linalg.norm(basis, axis=0)
        basis = basis / np.where(scale > 0, scale, 1.0)
        squares = np.zeros(n)
        for part in np.array_split(np.arange(steps), FOLDS):
            fitted = np.delete(basis, part, axis=0), np.delete(target_left, part, axis=0)
            coefficients = np.linalg.lstsq(*fitted, rcond=1e-11)[0]
            squares += np.sum((target_left[part] - basis[part] @ coefficients) ** 2, axis=0)
        return np.asarray(squares / steps + floor)

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
    return Leftover(left(), left(squares), each_order[best], left(squares, lagged[best]), late)


LONG_PREDICTION = 10  # steps of the longer prediction whose fit is stated
POOR = 50.0  # percent of its fit below which a model is called poor
BIASED = "Biased: "  # begins notes that are warned of


def quality_notes(
    found: Regression,
    fitted: list[Episode],
    tested: list[Episode],
    fits: tuple[Array, Array],
    ridge: float,
    memory: int = 0,
) -> list[str]:
    """Return notes on residuals, fit, excitation, bias and poles.

    ``fits`` (n,) are those one and more steps ahead in percent, and ``memory`` is how many of the
    last states are inputs on their way, of which nothing is in doubt.
    """
    n = found.reached.size - memory
    fits = fits[0][:n], fits[1][:n]
    notes = [
        f"Fitted to {found.steps} steps; one step differs from the prediction by "
        f"{listed_errors(found.covariance[:n, :n], found.spread)} (standard deviation of each "
        "state)."
    ]
    if tested:
        notes.append(_words_for(fits, sum(map(len, tested))))
    if found.excitation < WEAK:
        notes.append(
            f"Weakly excited: {found.weakest} moved {found.excitation:.1e} times as much as the "
            "most excited combination. Entries along it are uncertain."
        )
    if ridge > 0:
        notes.append(f"A ridge of {ridge:g} biases the entries towards zero.")
    notes += _residual_notes(found, fitted, n, bool(np.any(fits[1] < POOR)))
    more = any(each.endswith(UNTOLD) or each.startswith(CURVED) for each in notes)
    noise = "process noise" + " alone" * more
    return [*notes, pole_note(*pole_errors(found, n), noise)]


def _residual_notes(found: Regression, fitted: list[Episode], n: int, poor: bool) -> list[str]:
    """Return notes on what the residuals hold beside white noise: curvature, or colour.

    Much noise biases a model until its residuals are white: of a ``poor`` one earlier samples tell.
    """
    share, rest = curvature_test(found, fitted)
    share = share[:n]
    own = found.autocorrelation[:n]
    colored = np.abs(own) > 3 / np.sqrt(found.steps)
    left = leftover(fitted)
    notes = list[str]()
    known = bool(np.any(left.linear > 0))
    # What chance squares to is not there on rows that were held out.
    share = np.where(left.may_bend[:n] | (not known), share, 0.0)
    explained = 100 * (1 - left.lags[:n] / np.where(left.linear[:n] > 0, left.linear[:n], np.inf))
    explained = np.maximum(explained, 0.0)  # what errs more on rows held out explains nothing
    if np.any(share > 0):
        curved = (
            f"{CURVED}squares and products of states and inputs explain {listed(100 * share)} % "
            "of the residuals' variance. "
        )
        sure = not known or bool(np.any(left.bends[:n] & (share > 0)))
        cure = "record closer to the operating point, or learn what is missing (PlantTwin)."
        notes.append(
            f"{curved}The plant is not linear over this log: {cure}"
            if sure
            else f"{curved}Earlier states and inputs explain {listed(explained)} %: the plant is "
            f"not linear over this log, or it has a state that is not measured. If the former, "
            f"{cure}"
        )
        # What curvature explains is no noise.
        colored &= np.abs(neighbors(rest, fitted)[:n]) > 3 / np.sqrt(found.steps)
        # Where it explains much, what it leaves is curvature of higher order.
        # 0.5: share of the residuals from which on curvature explains their colour too
        colored &= share < 0.5
    elif np.any(explained > 100 * (1 - NOISE_SHARE)):
        return [
            f"Earlier states and inputs explain {listed(explained)} % of the residuals' variance, "
            "more than sensor noise lets them: there is a state that is not measured, or dead "
            "time. Append earlier readings and inputs to the states, or measure what is missing. "
            + UNTOLD
        ]
    # 10.0: percent that earlier samples explain of what a poor model leaves, where noise biases it
    poor &= bool(np.any(explained > 10.0)) and not np.any((share > 0) | (colored & (own > 0)))
    if poor or np.any(colored):
        which = (
            f"The residuals of neighboring steps are correlated ({listed(own)})"
            if np.any(colored)
            else f"Earlier states and inputs explain {listed(explained)} % of the residuals"
        )
        notes.append(
            f"{BIASED * poor}{which}: there is sensor noise, which biases A towards zero, or an "
            f"unmodeled state (identify_outputs models both). {UNTOLD}"
        )
    return notes


def _words_for(fits: tuple[Array, Array], steps: int) -> str:
    """Return a note on the fits to held-out data."""
    words = [
        f"{listed(fit)} % {ahead} ahead"
        for fit, ahead in zip(fits, ("one step", f"{LONG_PREDICTION} steps"), strict=True)
        if not np.all(np.isnan(fit))
    ]
    if not words:
        return f"The {steps} steps held out tell no fit: they are too few, or nothing moves."
    text = f"Fit over {steps} steps held out, 100 % is perfect: {', '.join(words)}."
    if len(words) < len(fits):
        text += f" No episode of them is {LONG_PREDICTION} steps long."
    if np.any(fits[1] < POOR):
        text += f" Poor: {LONG_PREDICTION} steps ahead the model says little of the plant."
    return text


def listed_errors(covariance: Array, spread: Array) -> str:
    """Return standard deviations (n,); those that are rounding beside the spread (n, ...) are 0."""
    sizes = np.sqrt(np.diag(covariance))
    return listed(np.where(sizes > FLOAT32_ROUNDING * spread[: sizes.size], sizes, 0.0))


def listed(values: Array) -> str:
    """Return numbers with three digits, separated by commas."""
    return ", ".join(f"{value:.3g}" for value in values)
