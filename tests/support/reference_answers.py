"""What an online QP answers, and random regulators to ask it of."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import strategies as st

from online_mpc import OnlineMPC
from sb3_yann import LinearModel, LinearMPC, Terminal


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


@st.composite
def random_problems(draw: st.DrawFn) -> LinearMPC:
    n, m, N = draw(st.integers(1, 3)), draw(st.integers(1, 2)), draw(st.integers(1, 2))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    A *= draw(st.sampled_from([0.5, 1.0, 1.3])) / np.max(np.abs(np.linalg.eigvals(A)))
    box = rng.uniform(0.5, 5, n)
    values: dict[str, Any] = {
        "Q": np.diag(rng.choice([0.1, 1.0, 10.0], n)),
        "R": np.diag(10 ** rng.uniform(-4, 1, m)),
        "horizon": N,
        "u_min": -rng.uniform(0.1, 2, m),
        "u_max": rng.uniform(0.1, 2, m),
        "gamma": draw(st.sampled_from([1.0, 0.95, 0.7])),
    }
    prefix = draw(st.sampled_from(["x", "theta"]))
    values |= {f"{prefix}_min": -box, f"{prefix}_max": box}
    if draw(st.booleans()):
        F = rng.normal(size=(int(rng.integers(1, 4)), n))
        values["terminal"] = Terminal(set=(F, rng.uniform(0.5, 3, len(F))))
    return LinearMPC(LinearModel(A, B, 1.0), **values)
