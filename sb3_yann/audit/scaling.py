"""Whether a reward is the cost of entries that are scaled or shifted: units, set-points, weights.

The cost is ``z' W z`` of ``z = [theta; u]``. Looked for are ``s`` and ``z0`` for which the rewards
are minus the cost of ``s * z + z0``, some entries of both being free and the others 1 and 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from sb3_yann._validation import Array
from sb3_yann.audit.sample import Mask, Sample


@dataclass(frozen=True)
class _Quadratic:
    """``z' W z`` over the counted steps, and the cost that their rewards imply."""

    z: Array
    W: Array
    implied: Array

    def predicted(self, s: Array, z0: Array, z: Array) -> Array:
        seen = s * z + z0
        return np.asarray(np.sum((seen @ self.W) * seen, axis=1))

    def fit(self, scaled: Mask, shifted: Mask) -> tuple[Array, Array]:
        """Return s and z0, free in the entries that are named, by least squares."""
        start = self._guess(scaled, shifted)
        if not shifted.any() and not np.any(self.W - np.diag(np.diag(self.W))):
            return start  # exact already: each entry stands for itself
        n = np.count_nonzero(scaled)

        def unpack(x: Array) -> tuple[Array, Array]:
            s, z0 = np.ones(len(self.W)), np.zeros(len(self.W))
            s[scaled], z0[shifted] = x[:n], x[n:]
            return s, z0

        def residual(x: Array) -> Array:
            return self.predicted(*unpack(x), self.z) - self.implied

        first = np.r_[start[0][scaled], start[1][shifted]]
        found = optimize.least_squares(
            residual, first, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=200
        )
        return unpack(found.x)

    def _guess(self, scaled: Mask, shifted: Mask) -> tuple[Array, Array]:
        """Return s and z0 as if entries did not act together, by linear least squares."""
        weight, k = np.diag(self.W), len(self.W)
        s, z0 = np.ones(k), np.zeros(k)
        fixed = self.predicted(np.where(scaled, 0.0, 1.0), z0, self.z)
        squares = self.z[:, scaled] ** 2 * weight[scaled]
        # Unscaled entries act together as W says: their part is known, and linear in the shift.
        linear = 2 * self.z @ self.W[:, shifted]
        columns = np.column_stack([squares, linear, np.ones(len(self.z))])
        size = np.maximum(np.abs(columns).max(axis=0), 1e-300)
        found = np.linalg.lstsq(columns / size, self.implied - fixed, rcond=1e-12)[0] / size
        n = np.count_nonzero(scaled)
        s[scaled] = np.sqrt(np.maximum(found[:n], 1e-12))
        z0[shifted] = found[n:-1] / s[shifted]
        return s, z0


def scaled_entries(sample: Sample, tolerance: float) -> tuple[str, str] | None:
    """Return the name of what fits and an explanation, None where nothing does."""
    z = np.column_stack([sample.theta, sample.u])
    W = _matrix(sample)
    if W is None:
        return None
    quadratic = _Quadratic(z[sample.counted], W, sample.implied[sample.counted])
    moves = np.ptp(quadratic.z, axis=0) > 0
    acts = np.any(W != 0, axis=1) & moves
    state = np.arange(len(W)) < sample.theta.shape[1]
    none = np.zeros(len(W), dtype=bool)
    for name, scaled, shifted in (
        ("shifted observation", none, acts & state),
        ("rescaled action", acts & ~state, acts & ~state),
        ("other weights", acts, none),
        ("normalized observation", acts & state, acts & state),
        ("normalized observation and action", acts, acts),
    ):
        free = np.count_nonzero(scaled) + np.count_nonzero(shifted)
        if free == 0 or len(quadratic.z) < 3 * free:
            continue
        s, z0 = quadratic.fit(scaled, shifted)
        if sample.agrees(quadratic.predicted(s, z0, z), tolerance):
            z0[np.abs(z0) < 1e-5 * np.abs(s)] = 0.0
            return name, _explanation(name, s, z0, state, W)
    return None


def _matrix(sample: Sample) -> Array | None:
    """Return W of the problem's stage cost, None where that is not such a form."""
    n, m = sample.theta.shape[1], sample.u.shape[1]

    def cost(z: Array) -> Array:
        return sample.stage_cost(z[:, :n], z[:, n:])

    unit = np.eye(n + m)
    alone = cost(unit)
    both = cost((unit[:, None] + unit).reshape(-1, n + m)).reshape(n + m, n + m)
    W: Array = (both - alone - alone[:, None]) / 2
    z = np.column_stack([sample.theta, sample.u])
    size = np.abs(sample.cost).max() + 1e-300
    return W if np.allclose(np.sum((z @ W) * z, 1) / size, sample.cost / size) else None


def _explanation(name: str, s: Array, z0: Array, state: NDArray[np.bool_], W: Array) -> str:
    theta_s, theta_0 = _listed(s[state]), _listed(z0[state])
    if name == "shifted observation":
        return (
            f"the cost is that of theta = obs + {theta_0}: observations are absolute values, or "
            'deviations from another point. Pass policy_kwargs={"observation": '
            f"AffineObservation.deviation({_listed(-z0[state])})}}."
        )
    if name == "rescaled action":
        return (
            f"the cost is that of the input {_listed(s[~state])} * action + {_listed(z0[~state])}: "
            "a RescaleAction, or an R of another size. Build the LinearMPC for the inputs that the "
            "env takes, with the weight that they have in its reward."
        )
    if name == "other weights":
        return (
            f"the reward weighs the entries of theta by {_listed(s[state] ** 2)} and of u by "
            f"{_listed(s[~state] ** 2)} times as much as Q and R of the problem: other weights, or "
            "other units (the square roots of these numbers)."
        )
    action = (
        ""
        if name == "normalized observation"
        else (f", and that of the input {_listed(s[~state])} * action + {_listed(z0[~state])}")
    )
    return (
        f"the cost is that of theta = {theta_s} * obs + {theta_0}{action}: observations are "
        'normalized. Pass policy_kwargs={"observation": '
        f"AffineObservation.normalized(mean={theta_0}, std={theta_s})}}."
    )


def _listed(values: Array) -> str:
    return "[" + ", ".join(f"{value + 0.0:.5g}" for value in values) + "]"
