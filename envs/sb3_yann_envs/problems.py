"""The linear MPC problems of the environments, with the settings of Braniff & Tian.

Both give the partition that the paper's parameter counts imply: 7 regions with 32 half-spaces for
the pendulum, 7 with 56 for the reactor. Where its text says otherwise, the docstrings say so.
"""

from __future__ import annotations

from sb3_yann.control import LinearModel, LinearMPC
from sb3_yann_envs import clipped_pendulum as pendulum
from sb3_yann_envs import cstr as reactor


def clipped_pendulum() -> LinearMPC:
    """Return the pendulum's MPC: N = 2, states and input in their boxes, undiscounted.

    Q is diag(1, 0.1), the weights of the environment's own cost. The identity, which the paper
    prints, gives 9 regions and 40 half-spaces instead. Where there is no solution, no torque is
    applied, as by the paper's network: the pendulum then swings through, and is often caught.

    Examples
    --------
    >>> clipped_pendulum().explicit()([3.0, 0.0])
    array([0.])
    """
    model = LinearModel(pendulum.PRINTED_A, pendulum.PRINTED_B, pendulum.DT)
    model = model.named(["angle", "speed"], ["torque"], ["rad", "rad/s", "N m"], time_unit="s")
    return LinearMPC(
        model,
        Q=pendulum.Q,
        R=pendulum.R,
        horizon=2,
        x_min=[-2.0, -8.0],
        x_max=[2.0, 8.0],
        u_min=-2.0,
        u_max=2.0,
        infeasible="zero_input",
    )


def cstr() -> LinearMPC:
    """Return the reactor's MPC: N = 2, undiscounted, in deviations, as the environment is.

    Its model has no operating point: the steady state is 0 here.

    The box of -2 to 2 mol/L and -70 to 5 K bounds the parameter only. With predicted
    states bounded as well, as the paper's text has it, there are 79 half-spaces instead of 56.

    Examples
    --------
    >>> cstr().explicit().n_halfspaces
    56
    """
    model = LinearModel(reactor.PRINTED_A, reactor.PRINTED_B, reactor.DT)
    units = [*["mol/L"] * 3, "K", "kJ/(h m² K)"]
    model = model.named(["C_A", "C_B", "C_S", "T"], ["U"], units, time_unit="h")
    return LinearMPC(
        model,
        Q=reactor.Q,
        R=reactor.R,
        horizon=2,
        u_min=-55.0,
        u_max=55.0,
        theta_min=[-2.0, -2.0, -2.0, -70.0],
        theta_max=[2.0, 2.0, 2.0, 5.0],
    )
