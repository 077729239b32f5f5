"""Notes on what a fit is worth: residuals, held-out data, excitation, bias and poles."""

from __future__ import annotations

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control.identification.curvature import bent
from sb3_yann.control.identification.hidden_states import NOISE, leftover
from sb3_yann.control.identification.least_squares import Regression, neighbors
from sb3_yann.control.identification.logs import Episode
from sb3_yann.control.identification.pole_errors import pole_note
from sb3_yann.control.identification.shrinkage import WEAK

AHEAD = 10  # steps of the longer prediction whose fit is stated
MUCH = 0.5  # share of the residuals from which on curvature explains their colour too
POOR = 50.0  # percent of the longer prediction's fit below which a model is called poor


def quality_notes(
    found: Regression,
    fitted: list[Episode],
    tested: list[Episode],
    fits: tuple[Array, Array],
    ridge: float,
    memory: int = 0,
) -> list[str]:
    """Return notes on residuals, fit, excitation, bias and poles.

    Parameters
    ----------
    found, fitted, tested : Regression and lists of Episode
        The fit, what it was fitted to, and what was held out.
    fits, ridge, memory : pair of ndarray (n,), float and int
        The fits one and more steps ahead in percent, the penalty, and how many of the last states
        are inputs on their way, of which nothing is in doubt.
    """
    n = found.reached.size - memory
    fits = fits[0][:n], fits[1][:n]
    notes = [
        f"Fitted to {found.steps} steps; one step differs from the prediction by "
        f"{listed(np.sqrt(np.diag(found.covariance))[:n])} (standard deviation of each state)."
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
    return [*notes, *_residual_notes(found, fitted, n), pole_note(found, n)]


def _residual_notes(found: Regression, fitted: list[Episode], n: int) -> list[str]:
    """Return notes on what the residuals hold beside white noise: curvature, or colour."""
    share, rest = bent(found, fitted)
    share, own = share[:n], found.autocorrelation[:n]
    colored = np.abs(own) > 3 / np.sqrt(found.steps)
    left, notes = leftover(fitted), list[str]()
    known = bool(np.any(left.linear > 0))
    # What chance squares to is not there on rows that were held out.
    share = np.where(left.may_bend[:n] | (not known), share, 0.0)
    explained = 100 * (1 - left.lags[:n] / np.where(left.linear[:n] > 0, left.linear[:n], np.inf))
    if np.any(share > 0):
        curved = (
            f"Curvature: squares and products of states and inputs explain {listed(100 * share)} % "
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
        colored &= share < MUCH
    elif np.any(explained > 100 * (1 - NOISE)):
        return [
            f"Earlier states and inputs explain {listed(explained)} % of the residuals' variance, "
            "more than sensor noise lets them: there is a state that is not measured, or dead "
            "time. Append earlier readings and inputs to the states, or measure what is missing. "
            "The standard errors do not tell that."
        ]
    if np.any(colored):
        notes.append(
            f"The residuals of neighboring steps are correlated ({listed(own)}): "
            "there is sensor noise, which biases A towards zero, or an unmodeled state. The "
            "standard errors do not tell that."
        )
    return notes


def _words_for(fits: tuple[Array, Array], steps: int) -> str:
    """Return a note on the fits to held-out data."""
    words = [
        f"{listed(fit)} % {ahead} ahead"
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


def listed(values: Array) -> str:
    """Return numbers with three digits, separated by commas."""
    return ", ".join(f"{value:.3g}" for value in values)
