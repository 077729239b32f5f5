"""Whether a reward is the cost of entries that are scaled or shifted: units, set-points, weights.

It looks for ``s`` and ``z0`` with ``reward = -(s z + z0)' W (s z + z0)``, ``z = [theta; u]``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize

from sb3_yann._validation import Array
from sb3_yann.audit.sample import Mask, Sample

APART = 0.02
"""Share of a scale by which two explanations differ that are not one and the same."""


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
        # The square of a shift is a constant: without one, an entry that hardly moves is no other.
        constant = np.ones((len(self.z), 1 if shifted.any() else 0))
        columns = np.column_stack([squares, linear, constant])
        size = np.maximum(np.abs(columns).max(axis=0), 1e-300)
        found = np.linalg.lstsq(columns / size, self.implied - fixed, rcond=1e-12)[0] / size
        n = np.count_nonzero(scaled)
        s[scaled] = np.sqrt(np.maximum(found[:n], 1e-12))
        z0[shifted] = found[n : n + np.count_nonzero(shifted)] / s[shifted]
        return s, z0


def scaled_entries(sample: Sample, tolerance: float) -> list[tuple[str, str, str]]:
    """Return the names of all that fit with other numbers, with an explanation and a cure.

    What is freer fits as well: it counts where it comes to another point, since then the sample
    does not tell the two apart.
    """
    z = np.column_stack([sample.theta, sample.u])
    if (W := _matrix(sample)) is None:
        return []
    fitting: list[tuple[str, Array, Array]] = []
    quadratic = _Quadratic(z[sample.counted], W, sample.implied[sample.counted])
    moves = np.ptp(quadratic.z, axis=0) > 0
    acts = np.any(W != 0, axis=1) & moves
    # What stands still has a weight all the same: a saturated input costs the same at each step.
    weighed = np.any(W != 0, axis=1) & np.any(quadratic.z != 0, axis=0)
    state = np.arange(len(W)) < sample.theta.shape[1]
    none = np.zeros(len(W), dtype=bool)
    for name, scaled, shifted in (
        ("shifted observation", none, acts & state),
        ("rescaled action", acts & ~state, acts & ~state),
        ("other weights", weighed, none),
        ("normalized observation", acts & state, acts & state),
        ("normalized observation and action", acts, acts),
    ):
        free = np.count_nonzero(scaled) + np.count_nonzero(shifted)
        if free == 0 or len(quadratic.z) < 3 * free:
            continue
        s, z0 = quadratic.fit(scaled, shifted)
        if sample.agrees(quadratic.predicted(s, z0, z), tolerance):
            z0[np.abs(z0) < 1e-5 * np.abs(s)] = 0.0
            found = np.r_[s, z0]
            near = [np.allclose(found, np.r_[each[1:]], rtol=APART, atol=APART) for each in fitting]
            if not any(near):
                fitting.append((name, s, z0))
    rest = np.append(sample.theta_ss, np.zeros(sample.u.shape[1]))
    # In plant units, which the map of an observation leads to.
    return [(name, *_explanation(name, s, z0 + (1 - s) * rest, state)) for name, s, z0 in fitting]


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


def _explanation(name: str, s: Array, z0: Array, state: Mask) -> tuple[str, str]:
    """Return what is the matter, and a cure where there is one other than that."""
    scale, shift = _listed(s[state]), _listed(z0[state])
    u = f"the input {_listed(s[~state])} * action + {_listed(z0[~state])}"
    if name == "rescaled action":
        return (
            f"the cost is that of {u}: a RescaleAction, or an R of another size. Build the "
            "LinearMPC for the inputs that the env takes, with their weight in its reward."
        ), ""
    if name == "other weights":
        return (
            f"the reward weighs the entries of theta by {_listed(s[state] ** 2)} and of u by "
            f"{_listed(s[~state] ** 2)} times as much as Q and R of the problem: other weights, or "
            "other units (the square roots of these numbers)."
        ), ""
    if name == "shifted observation":
        what = f"theta = obs + {shift}: observations count from another point"
        undo = f"deviation({_listed(-z0[state])})"
    else:
        what = f"theta = {scale} * obs + {shift}{f', and {u}' if 'action' in name else ''}: "
        what += "observations are normalized"
        undo = f"normalized(mean={shift}, std={scale})"
    undo = f'policy_kwargs={{"observation": AffineObservation.{undo}}}'
    return f"the cost is that of {what}.", f" Pass {undo}."


def _listed(values: Array) -> str:
    return "[" + ", ".join(f"{value + 0.0:.5g}" for value in values) + "]"
