"""Whether a law in deviations is shown absolute states: the counterpart of absolute inputs."""

from __future__ import annotations

from sb3_yann._validation import Array
from sb3_yann.audit.causes import Cause
from sb3_yann.control import LinearMPC
from sb3_yann.control.mpc.plant_units import misread_state


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
    >>> import numpy as np
    >>> from sb3_yann.control import LinearModel
    >>> model = LinearModel([[0.9]], [[1]], dt=1, x_ss=[350])
    >>> mpc = LinearMPC(model, Q=[[1]], R=[[1]], horizon=1, x_min=-9, x_max=9, u_min=-1, u_max=1)
    >>> absolute_observation(mpc, np.array([[352.0], [349.0]])).name
    'absolute observation'
    """
    if misread_state(problem, theta) is None:
        return None
    shown, point = theta[0, problem.layout.state].tolist(), problem.model.x_ss.tolist()
    return Cause(
        "absolute observation",
        f"the states that the env shows, such as {shown}, lie outside the box of the "
        f"law, and inside it with x_ss = {point} taken off: they are absolute, and the law takes "
        "deviations. Wrap the plant in sb3_yann.wrappers.Deviations(env, mpc.model), or pass "
        'policy_kwargs={"observation": "absolute"}.',
    )
