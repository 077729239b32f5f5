"""The ridge of a weakly excited log, chosen by free runs over held-out data."""

from __future__ import annotations

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control.identification.least_squares import Regression, regress
from sb3_yann.control.identification.logs import Episode, split

WEAK = 0.01  # excitation below which a log is weak
RIDGES = 10.0 ** np.arange(-9, 0)
"""Ridges that are tried, relative to the number of steps."""
BLIND = 1.0  # error of free runs, in spreads of the states, from which the mean says as much
FREE_RUN = 50  # steps of a free run


def regularized(
    found: Regression,
    fitted: list[Episode],
    tested: list[Episode],
    sizes: tuple[int, int, int],
    origin: Array | None,
) -> tuple[Regression, float, list[str]]:
    """Return the fit, its ridge and notes; a log that is not weak has none.

    What a weak log says along the direction that moved least is noise or curvature, and one-step
    predictions do not show it. Free runs do.

    Parameters
    ----------
    found, fitted, tested : Regression and lists of Episode
        The fit without ridge, what it was fitted to, and what was held out.
    sizes, origin : tuple of int, and ndarray (n+m+d,) or None
        As of `regress`.

    Raises
    ------
    ValueError
        If a weak log leaves free runs as blind as the mean, with any ridge.
    """
    if found.excitation >= WEAK:
        return found, 0.0, []
    inner, outer = (fitted, tested) if tested else split(fitted, 0.2)
    ridges = np.array([0.0, *RIDGES]) * found.steps
    errors = np.array([_free_run(regress(inner, sizes, origin, r), outer) for r in ridges])
    if np.min(errors) >= BLIND:
        raise ValueError(
            f"The log is too weakly excited: {found.weakest} moved {found.excitation:.1e} times as "
            "much as the most excited combination, and with any ridge free runs over the data held "
            f"out miss by {np.min(errors):.2g} spreads of the states. Add a test signal to each "
            "input and record longer, or pass ridge=0 (or another number) to take such a fit."
        )
    # What rounding leaves of a perfect log counts as nothing.
    best = int(np.argmax(errors <= np.min(errors) + 1e-9))
    if best == 0:
        return found, 0.0, []
    note = (
        f"A ridge of {ridges[best]:.2g} was chosen by free runs over data held out: they miss by "
        f"{errors[best]:.2g} spreads of the states, without it by {errors[0]:.2g}. It biases "
        "weakly excited entries towards zero, which their standard errors leave out."
    )
    return regress(fitted, sizes, origin, float(ridges[best])), float(ridges[best]), [note]


def _free_run(found: Regression, episodes: list[Episode]) -> float:
    """Return the error of free runs, root mean square in spreads of the states."""
    n, total, count = found.reached.size, 0.0, 0
    unit = np.where(found.spread[:n] > 0, found.spread[:n], 1.0)
    for episode in episodes:
        for start in range(0, len(episode), FREE_RUN):
            x = episode.states[start]
            for k in range(start, min(start + FREE_RUN, len(episode))):
                x = found.predict(np.concatenate([x, episode.driven[k]])[None])[0]
                # One that runs away is as bad as can be, and its size tells nothing.
                error = np.minimum(np.abs(x - episode.states[k + 1]) / unit, 1e3)
                x = np.clip(x, -1e150, 1e150)
                total, count = total + float(np.mean(error**2)), count + 1
    return float(np.sqrt(total / max(count, 1)))
