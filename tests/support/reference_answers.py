"""What an online QP answers, and how far from it another answer is."""

import numpy as np

from online_mpc import OnlineMPC
from sb3_yann import LinearMPC


def online_answers(mpc: LinearMPC, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the inputs at the feasible points (k, m), and which points those are (count,)."""
    online = OnlineMPC(mpc)
    answers = [online(point) for point in points]
    feasible = np.array([u is not None for u in answers])
    inputs = [u for u in answers if u is not None]
    return np.reshape(inputs, (len(inputs), mpc.model.n_inputs)), feasible


def relative_error(mpc: LinearMPC, actual: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference, as a share of the input range."""
    width = mpc.u_max - mpc.u_min
    return float(np.max(np.abs(actual - expected) / np.where(np.isfinite(width), width, 1.0)))
