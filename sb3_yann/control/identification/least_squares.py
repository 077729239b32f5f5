"""Least squares on measured steps: coefficients, their standard errors, and the excitation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control.identification.logs import Episode

WEAKEST = 1e-6
"""Least excitation, below which float32 rounding alone may be what moves."""


@dataclass(frozen=True, eq=False)
class Regression:
    """``x[k+1] = reached + coefficients (z[k] - center)``, with z of states, inputs, disturbances.

    Attributes
    ----------
    coefficients, standard_errors : ndarray, shape (n, n+m+d)
    center : ndarray, shape (n+m+d,)
    reached : ndarray, shape (n,)
    spread : ndarray, shape (n+m+d,)
        Root mean square of each regressor about the center.
    factors : ndarray, shape (n+m+d,)
        Standard errors of each column in units of the residuals' standard deviation.
    covariance : ndarray, shape (n, n)
        Of the residuals.
    autocorrelation : ndarray, shape (n,)
        Of the residuals, one step apart; zero where they are rounding.
    degrees_of_freedom, steps : int
    excitation : float
        Smallest over largest singular value of the regressors in units of their spread.
    weakest : str
        The combination of regressors that moved least.
    """

    coefficients: Array
    standard_errors: Array
    center: Array
    reached: Array
    spread: Array
    factors: Array
    covariance: Array
    autocorrelation: Array
    degrees_of_freedom: int
    steps: int
    excitation: float
    weakest: str

    def predict(self, regressors: Array) -> Array:
        """Return the next states (k, n) for regressors (k, n+m+d)."""
        return np.asarray(self.reached + (regressors - self.center) @ self.coefficients.T)


def regress(
    episodes: list[Episode], sizes: tuple[int, int, int], origin: Array | None, ridge: float
) -> Regression:
    """Return the least-squares fit of one step.

    Parameters
    ----------
    episodes : list of Episode
        The measured steps.
    sizes : tuple of int
        Numbers of states, inputs and disturbances.
    origin : ndarray, shape (n+m+d,), optional
        The fit passes through it. The default is the mean of the data: an offset is fitted.
    ridge : float
        Penalty on the squared coefficients, each in units of its regressor's spread.
    """
    n = sizes[0]
    regressors = np.concatenate([episode.regressors for episode in episodes])
    targets = np.concatenate([episode.states[1:] for episode in episodes])
    steps, unknowns = regressors.shape[0], regressors.shape[1] + (origin is None)
    if steps <= unknowns:
        raise ValueError(
            f"There are {steps} steps to fit {unknowns} parameters for each state: more steps than "
            "parameters are needed. Record more, or hold less out (held_out)."
        )
    center = np.mean(regressors, axis=0) if origin is None else origin
    reached = np.mean(targets, axis=0) if origin is None else origin[:n]
    centered = regressors - center
    spread = np.sqrt(np.mean(centered**2, axis=0))
    # What is left of a constant after its mean is taken off is rounding, not a signal.
    still = spread <= 1e-10 * np.max(np.abs(regressors), axis=0)
    scale = np.where(still, 1.0, spread)
    left, sizes_of, right = np.linalg.svd(np.where(still, 0.0, centered / scale), False)
    excitation = float(sizes_of[-1] / sizes_of[0]) if sizes_of[0] > 0 else 0.0
    missing = [v for s, v in zip(sizes_of, right, strict=True) if s <= WEAKEST * sizes_of[0]]
    if missing and ridge == 0:
        raise ValueError(_not_excited([direction(v / scale, v, sizes) for v in missing]))
    inverse = right.T * (sizes_of / (sizes_of**2 + ridge)) if ridge else right.T / sizes_of
    coefficients = ((inverse @ left.T @ (targets - reached)) / scale[:, None]).T
    residuals = targets - reached - centered @ coefficients.T
    freedom = steps - unknowns
    covariance = residuals.T @ residuals / freedom
    factors = np.linalg.norm(inverse, axis=1) / scale
    return Regression(
        coefficients=coefficients,
        standard_errors=np.sqrt(np.diag(covariance))[:, None] * factors,
        center=center,
        reached=reached,
        spread=spread,
        factors=factors,
        covariance=covariance,
        autocorrelation=_autocorrelation(residuals, episodes, targets),
        degrees_of_freedom=freedom,
        steps=steps,
        excitation=excitation,
        weakest=direction(right[-1] / scale, right[-1], sizes),
    )


def direction(coefficients: Array, weights: Array, sizes: tuple[int, int, int]) -> str:
    """Return a combination of states, inputs and disturbances in words.

    Terms with small `weights`, in units of their spread, are left out.
    """
    n, m, d = sizes
    labels = (*(("x", i) for i in range(n)), *(("u", i) for i in range(m)))
    names = [f"{name}[{i}]" for name, i in (*labels, *(("d", i) for i in range(d)))]
    kept = np.flatnonzero(np.abs(weights) > 0.05 * np.max(np.abs(weights)))
    first = coefficients[kept[np.argmax(np.abs(weights[kept]))]]
    if kept.size == 1:
        return names[int(kept[0])]
    terms = [f"{coefficients[i] / first:+.4g} {names[i]}" for i in kept]
    return " ".join(terms).removeprefix("+")


def _not_excited(missing: list[str]) -> str:
    return (
        "The data do not excite the plant: "
        + "; ".join(f"{words} never changes" for words in missing)
        + ". What does not move cannot be identified. Add a test signal to each input, independent "
        "of the state (a feedback law alone ties the inputs to it), leave out states that are "
        "constant or sums of others, or pass ridge > 0."
    )


def _autocorrelation(residuals: Array, episodes: list[Episode], targets: Array) -> Array:
    """Return the correlation of each state's residuals with those one step before."""
    borders = np.cumsum([len(episode) for episode in episodes])[:-1]
    pairs = sum(np.sum(part[1:] * part[:-1], axis=0) for part in np.split(residuals, borders))
    power = np.sum(residuals**2, axis=0)
    real = power > 1e-20 * np.sum(targets**2, axis=0)
    return np.asarray(np.where(real, pairs / np.where(real, power, 1.0), 0.0))
