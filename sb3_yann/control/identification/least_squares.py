"""Least squares on measured steps: coefficients, their standard errors, and the excitation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control.identification.logs import Episode
from sb3_yann.control.linear_system import combination, names

WEAKEST = 1e-6  # least excitation, below which float32 rounding alone may be what moves

SMALL = 0.05  # relative weight below which a regressor is left out of a combination
NOT_EXCITED = (
    "What does not move cannot be identified. Add a test signal to each input, independent of the "
    "state (a feedback law alone ties the inputs to it), leave out states that are constant or "
    "sums of others, or pass ridge > 0."
)


@dataclass(frozen=True, eq=False)
class Regression:
    """``x[k+1] = reached + coefficients (z[k] - center)``, n states x, p regressors z.

    Attributes
    ----------
    coefficients, standard_errors : ndarray, shape (n, p)
    center, reached : ndarray, shapes (p,) and (n,)
    spread, factors : ndarray, shape (p,)
        Root mean square about the center; a column's standard errors over the residuals' deviation.
    correlation : ndarray, shape (p, p)
        ``outer(covariance, correlation)`` is the coefficients' covariance.
    covariance, autocorrelation : ndarray, shapes (n, n) and (n,)
        Of the residuals; the latter one step apart, zero where they are rounding.
    degrees_of_freedom, steps : int
    excitation, weakest : float and str
        Smallest over largest singular value of the scaled regressors; what moved least.
    """

    coefficients: Array
    standard_errors: Array
    center: Array
    reached: Array
    spread: Array
    factors: Array
    correlation: Array
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
    episodes, sizes : list of Episode, and tuple of int
        The measured steps, and the numbers of states, inputs and disturbances.
    origin : ndarray, shape (n+m+d,), optional
        The fit passes through it. The default is the mean of the data: an offset is fitted.
    ridge : float
        Penalty on the squared coefficients, each in units of its regressor's spread.
    """
    regressors = np.concatenate([episode.regressors for episode in episodes])
    targets = np.concatenate([episode.states[1:] for episode in episodes])
    steps, unknowns = regressors.shape[0], regressors.shape[1] + (origin is None)
    if steps <= unknowns:
        raise ValueError(
            f"There are {steps} steps to fit {unknowns} parameters for each state: too few. Record "
            "more, or hold less out (held_out)."
        )
    center = np.mean(regressors, axis=0) if origin is None else origin
    reached = np.mean(targets, axis=0) if origin is None else origin[: sizes[0]]
    centered = regressors - center
    spread = np.sqrt(np.mean(centered**2, axis=0))
    # What is left of a constant after its mean is taken off is rounding, not a signal.
    still = spread <= 1e-10 * np.max(np.abs(regressors), axis=0)
    scale = np.where(still, 1.0, spread)
    left, singular, right = np.linalg.svd(np.where(still, 0.0, centered / scale), False)
    labels = names(sizes)
    missing = [v for s, v in zip(singular, right, strict=True) if s <= WEAKEST * singular[0]]
    if missing and ridge == 0:
        fixed = [f"{_direction(v, scale, labels)} never changes" for v in missing]
        raise ValueError(f"The data do not excite the plant: {'; '.join(fixed)}. {NOT_EXCITED}")
    inverse = right.T * (singular / (singular**2 + ridge)) if ridge else right.T / singular
    coefficients = ((inverse @ left.T @ (targets - reached)) / scale[:, None]).T
    residuals = targets - reached - centered @ coefficients.T
    covariance = residuals.T @ residuals / (steps - unknowns)
    factors = np.linalg.norm(inverse, axis=1) / scale
    return Regression(
        coefficients=coefficients,
        standard_errors=np.sqrt(np.diag(covariance))[:, None] * factors,
        center=center,
        reached=reached,
        spread=spread,
        factors=factors,
        correlation=(inverse / scale[:, None]) @ (inverse / scale[:, None]).T,
        covariance=covariance,
        autocorrelation=_autocorrelation(residuals, episodes, targets),
        degrees_of_freedom=steps - unknowns,
        steps=steps,
        excitation=float(singular[-1] / singular[0]) if singular[0] > 0 else 0.0,
        weakest=_direction(right[-1], scale, labels),
    )


def _direction(weights: Array, scale: Array, labels: list[str]) -> str:
    """Return a combination of the scaled regressors in words, without terms of small weight."""
    largest, factors = np.argmax(np.abs(weights)), weights / scale
    small = np.abs(weights) <= SMALL * np.abs(weights[largest])
    return combination(np.where(small, 0.0, factors / factors[largest]), labels, 4)


def _autocorrelation(residuals: Array, episodes: list[Episode], targets: Array) -> Array:
    """Return the correlation of each state's residuals with those one step before."""
    real = np.sum(residuals**2, axis=0) > 1e-20 * np.sum(targets**2, axis=0)
    return np.asarray(np.where(real, neighbors(residuals, episodes), 0.0))


def neighbors(residuals: Array, episodes: list[Episode]) -> Array:
    """Return the correlation (n,) of residuals (steps, n) with those one step before."""
    borders = np.cumsum([len(episode) for episode in episodes])[:-1]
    pairs = sum(np.sum(part[1:] * part[:-1], axis=0) for part in np.split(residuals, borders))
    power = np.sum(residuals**2, axis=0)
    return np.asarray(pairs / np.where(power > 0, power, 1.0))
