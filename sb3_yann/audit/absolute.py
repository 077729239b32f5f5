"""Whether a law in deviations is shown absolute states: the counterpart of absolute inputs."""

from __future__ import annotations

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.audit.causes import Cause
from sb3_yann.control import LinearMPC

MOST = 0.9  # share of the steps that must speak for it


def absolute_observation(problem: LinearMPC, theta: Array) -> Cause | None:
    """Return that theta holds absolute states, None where it does not seem so.

    They lie outside the box of the law, and inside with the operating point taken off. The reward
    need not tell: a cost of absolute states agrees with what is shown.

    Parameters
    ----------
    problem : LinearMPC
        Its theta counts from the model's operating point.
    theta : ndarray, shape (steps, n_theta)
        As the law got it.

    Examples
    --------
    >>> from sb3_yann.control import LinearModel
    >>> model = LinearModel([[0.9]], [[1]], dt=1, x_ss=[350])
    >>> mpc = LinearMPC(model, Q=[[1]], R=[[1]], horizon=1, x_min=-9, x_max=9, u_min=-1, u_max=1)
    >>> absolute_observation(mpc, np.array([[352.0], [349.0]])).name
    'absolute observation'
    """
    x_ss, states = problem.model.x_ss, problem.layout.state
    if not len(theta) or not np.any(x_ss):
        return None
    low, high = problem.theta_min[states], problem.theta_max[states]
    reach = 1e-6 * problem.theta_half[states]
    shown, meant = theta[:, states], theta[:, states] - x_ss
    kept, inside = (
        np.all((low - reach <= x) & (x <= high + reach), axis=1) for x in (shown, meant)
    )
    if np.mean(~kept) < MOST or np.mean(inside) < MOST:
        return None
    point = x_ss.tolist()
    return Cause(
        "absolute observation",
        f"the states that the env shows, such as {shown[0].tolist()}, lie outside the box of the "
        f"law, and inside it with x_ss = {point} taken off: they are absolute, and the law takes "
        "deviations. Wrap the plant in sb3_yann.wrappers.Deviations(env, mpc.model), or pass "
        f'policy_kwargs={{"observation": AffineObservation.deviation({point})}}.',
    )
