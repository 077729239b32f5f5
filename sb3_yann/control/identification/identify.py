"""Linear models from measured data, by least squares, and how sure they are."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from sb3_yann._validation import Array, ReadOnlyArrays, as_array, as_positive, to_float
from sb3_yann.control.identification.input_delays import input_notes
from sb3_yann.control.identification.least_squares import Regression, regress
from sb3_yann.control.identification.logs import Episode, as_episodes, split, without_gaps
from sb3_yann.control.identification.operating_point import FAR, operating_point
from sb3_yann.control.model.linear_model import LinearModel

AHEAD = 10
"""Steps of the longer prediction whose fit is stated."""
POOR = 50.0
"""Percent of the longer prediction's fit below which a model is called poor."""


@dataclass(frozen=True, eq=False)
class Identified(ReadOnlyArrays):
    """A model fitted to data, with what the data say of it.

    Attributes
    ----------
    model : LinearModel
        Its notes, and so its report, state the fit in words.
    standard_error_A, standard_error_B, standard_error_E : ndarray, shapes of A, B and E
        Standard errors of the entries, for process noise (see :func:`identify`).
    noise_covariance : ndarray, shape (n, n)
        Covariance of what one step differs from the prediction by.
    degrees_of_freedom : int
        Steps fitted minus parameters of each row.
    residual_autocorrelation : ndarray, shape (n,)
        Of each state's residuals, one step apart. Far from zero, there is measurement noise or an
        unmodeled state, and neither the matrices nor the standard errors hold.
    one_step_fit, ten_step_fit : ndarray, shape (n,)
        ``100 (1 - |x - predicted| / |x - mean|)`` in percent for each state over the data that
        were held out, predicted one step ahead, and ten with the inputs as measured. 100 is
        perfect, 0 no better than the mean. NaN without such data, or of a state that never moves.
    excitation : float
        The least that any combination of states and inputs moved, each in units of its own
        spread, relative to the most. Below 1e-6 the data are refused.
    """

    model: LinearModel
    standard_error_A: Array
    standard_error_B: Array
    standard_error_E: Array
    noise_covariance: Array
    degrees_of_freedom: int
    residual_autocorrelation: Array
    one_step_fit: Array
    ten_step_fit: Array
    excitation: float

    def interval(self, name: str, level: float = 0.95) -> tuple[Array, Array]:
        """Return the lower and upper ends of each entry's confidence interval.

        Parameters
        ----------
        name : {"A", "B", "E"}
            Which matrix.
        level : float, default 0.95
            Probability with which a true entry lies inside: each for itself, Student's t.

        Raises
        ------
        ValueError
            For another name, or a level outside (0, 1).
        """
        if name not in ("A", "B", "E"):
            raise ValueError(f"name = {name!r} must be 'A', 'B' or 'E'.")
        if not 0 < level < 1:
            raise ValueError(f"level = {level!r} must lie in (0, 1).")
        value, error = getattr(self.model, name), getattr(self, f"standard_error_{name}")
        width = stdtrit(self.degrees_of_freedom, (1 + level) / 2) * error
        return value - width, value + width


def identify(
    states: ArrayLike | Sequence[ArrayLike],
    actions: ArrayLike | Sequence[ArrayLike],
    *,
    dt: float,
    disturbances: ArrayLike | Sequence[ArrayLike] | None = None,
    x_ss: ArrayLike | None = None,
    u_ss: ArrayLike | None = None,
    d_ss: ArrayLike | None = None,
    offset: bool = True,
    ridge: float = 0.0,
    held_out: float = 0.2,
    time: ArrayLike | Sequence[ArrayLike] | None = None,
) -> Identified:
    r"""Fit ``x[k+1] = A x[k] + B u[k] + E d[k] + c`` to measured episodes by least squares.

    The estimate is consistent, and its standard errors hold in long records, where what disturbs
    the plant is *process noise*: independent from step to step and acting on the state itself
    (Ljung, *System Identification*, 2nd ed., section 7.3 and appendix II). Noise of the *sensors*
    stands on both sides of the equation and biases A towards zero (errors in variables), the same
    however long the record is, while the standard errors shrink and know nothing of it. Measured
    on a plant with the poles .9 and .7: noise of 2 % of each state's spread lowers both by .0004,
    of 10 % by .009. After 400 steps that is within the standard errors; after 4,000, at 10 %, no
    95 % interval holds the pole. It shows in the residuals, which then alternate, and the notes of
    the model say so.

    Parameters
    ----------
    states : array_like, shape (T+1, n), or a sequence of such
        One episode or several, each with the state before every action and after the last.
    actions : array_like, shape (T, m), or a sequence of such
        The inputs as they were executed (clipped, if the plant clips).
    dt : float
        Sampling time.
    disturbances : array_like, shape (T, d), or a sequence of such, optional
        Measured disturbances, which make E.
    x_ss, u_ss, d_ss : array_like, shapes (n,), (m,) and (d,), optional
        The operating point. Left out, inputs and disturbances take their mean, and the state is
        where the fitted model rests with them. Along what integrates, as far as the data tell, the
        state keeps its mean, and the inputs are those that hold it.
    offset : bool, default True
        Fit c too, so that the operating point need not be a steady state exactly. Without it,
        deviations from (x_ss, u_ss, d_ss), zeros where left out, are fitted with c = 0.
    ridge : float, default 0
        Weight of the squared entries, each in units of the spread of its regressor, relative to
        that of one step. It makes data that do not excite the plant usable, at the price of a
        bias towards zero that the standard errors do not contain.
    held_out : float, default 0.2
        Fraction of all steps that is kept out of the model to state its fit: the last ones, for
        which an episode is cut in two.
    time : array_like, shape (T+1,), or a sequence of such, optional
        When each row of the states was measured, in the unit of ``dt``. Steps that took another
        time, by more than 10 %, are left out: a log with missing rows is no record of the plant.

    Returns
    -------
    Identified

    Raises
    ------
    TypeError, ValueError
        For arrays that do not fit each other, hold NaN or are too few, and for data in which some
        combination of states and inputs does not move: the message names it.
    """
    episodes, sizes = as_episodes(states, actions, disturbances)
    lost = 0
    if time is not None:
        episodes, lost = without_gaps(episodes, time, as_positive("dt", dt))
    n, m, d = sizes
    if d_ss is not None and disturbances is None:
        raise ValueError("d_ss is given, but there are no disturbances: pass these as well.")
    given = (
        _given("x_ss", x_ss, n, offset),
        _given("u_ss", u_ss, m, offset),
        _given("d_ss", d_ss, d, offset),
    )
    fitted, tested = split(episodes, float(to_float("held_out", held_out)))
    weight = float(to_float("ridge", ridge))
    if not 0 <= weight < np.inf:
        raise ValueError(f"ridge = {ridge!r} must be 0 or a finite number above it.")
    origin = None if offset else np.concatenate([part for part in given if part is not None])
    found = regress(fitted, sizes, origin, weight)
    fits = (_fit(found, tested, 1), _fit(found, tested, AHEAD))
    A, B, E = np.split(found.standard_errors, [n, n + m], axis=1)
    model = _model(found, sizes, given, dt).with_notes(*_quality(found, tested, fits, weight))
    late = input_notes(found, fitted, sizes)
    if late:
        warnings.warn(" ".join(late), stacklevel=2)
        model = model.with_notes(*late)
    if lost:
        model = model.with_notes(f"{lost} steps that took another time than dt were left out.")
    return Identified(
        model=model,
        standard_error_A=A,
        standard_error_B=B,
        standard_error_E=E,
        noise_covariance=found.covariance,
        degrees_of_freedom=found.degrees_of_freedom,
        residual_autocorrelation=found.autocorrelation,
        one_step_fit=fits[0],
        ten_step_fit=fits[1],
        excitation=found.excitation,
    )


def _given(name: str, value: ArrayLike | None, size: int, offset: bool) -> Array | None:
    """Return an operating point that is given, None if it is to be found."""
    if value is None:
        return None if offset else np.zeros(size)
    return as_array(name, value, (size,))


def _model(
    found: Regression, sizes: tuple[int, int, int], given: Sequence[Array | None], dt: float
) -> LinearModel:
    """Return the model about its operating point, with a note if the plant moves there."""
    n, m, _ = sizes
    point = operating_point(found, sizes, given)
    A, B, E = np.split(found.coefficients, [n, n + m], axis=1)
    x, u, d = np.split(point, [n, n + m])
    model = LinearModel(A, B, dt, x, u, E, d)
    drift = found.predict(point[None])[0] - x
    doubt = np.diag(found.covariance) / found.steps
    doubt = np.sqrt(doubt + found.standard_errors**2 @ (point - found.center) ** 2)
    allowed = 3 * doubt + 1e-9 * (1 + np.abs(x))
    if np.any(np.abs(drift) > allowed):
        model = model.with_drift(drift).with_notes(
            f"At the operating point the fitted plant moves by {_list(drift)} in one step. The "
            "model leaves that out."
        )
    away = np.abs(x - found.center[:n]) > FAR * found.spread[:n]
    if np.any(away):
        model = model.with_notes(
            f"x_ss[{int(np.argmax(away))}] lies far outside the data: the model is extrapolated."
        )
    return model


def _fit(found: Regression, episodes: list[Episode], steps: int) -> Array:
    """Return the fit in percent of each state (n,), predicted so many steps ahead."""
    errors, targets = [], []
    for episode in episodes:
        starts = len(episode) - steps + 1
        if starts < 1:
            continue
        x = episode.states[:starts]
        for k in range(steps):
            x = found.predict(np.hstack([x, episode.driven[k : k + starts]]))
        errors.append(x - episode.states[steps:])
        targets.append(episode.states[steps:])
    n = found.reached.size
    if not errors:
        return np.full(n, np.nan)
    target = np.concatenate(targets)
    moved = np.linalg.norm(target - np.mean(target, axis=0), axis=0)
    missed = np.linalg.norm(np.concatenate(errors), axis=0)
    return np.asarray(100 * (1 - missed / np.where(moved > 0, moved, np.nan)))


def _quality(
    found: Regression, tested: list[Episode], fits: tuple[Array, Array], ridge: float
) -> list[str]:
    """Return what the data say of the model, in words."""
    notes = [
        f"Fitted to {found.steps} steps; one step differs from the prediction by "
        f"{_list(np.sqrt(np.diag(found.covariance)))} (standard deviation of each state)."
    ]
    if tested:
        notes.append(_words_for(fits, sum(map(len, tested))))
    if found.excitation < 0.01:
        notes.append(
            f"Weakly excited: {found.weakest} moved {found.excitation:.1e} times as much as the "
            "most excited combination. Entries along it are uncertain."
        )
    if ridge > 0:
        notes.append(f"A ridge of {ridge:g} biases the entries towards zero.")
    colored = np.abs(found.autocorrelation) > 3 / np.sqrt(found.steps)
    if np.any(colored):
        notes.append(
            f"The residuals of neighboring steps are correlated ({_list(found.autocorrelation)}): "
            "there is sensor noise or an unmodeled state. A is biased, towards zero by noise, by "
            "more than the standard errors tell."
        )
    return notes


def _words_for(fits: tuple[Array, Array], steps: int) -> str:
    """Return the fits over data held out in words, a poor one as such."""
    words = [
        f"{_list(fit)} % {ahead} ahead"
        for fit, ahead in zip(fits, ("one step", f"{AHEAD} steps"), strict=True)
        if not np.all(np.isnan(fit))
    ]
    if not words:
        return f"The {steps} steps held out tell no fit: they are too few, or nothing moves."
    text = f"Fit over {steps} steps held out, 100 % is perfect: {', '.join(words)}."
    if len(words) < len(fits):
        text += f" No episode of them is {AHEAD} steps long."
    if np.any(fits[1] < POOR):
        text += f" Poor: {AHEAD} steps ahead the model says little of the plant."
    return text


def _list(values: Array) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
