"""Laws of problems with terminal equalities, against a QP that keeps all states."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from reference_answers import online_answers, relative_error
from sample_problems import box_points
from sb3_yann import LinearModel, LinearMPC, SoftBounds, Terminal
from sb3_yann.control import PiecewiseAffine

SLIDER = LinearModel([[1, 0.2], [0, 0.95]], [[0.02], [0.2]], dt=0.2)
MIXER = LinearModel([[1.1, 0.2], [0, 0.9]], [[1, 0.3], [0.2, 1]], dt=1.0)
FAST = LinearModel([[1.7, 0.2], [0, 0.9]], [[1, 0.3], [0.2, 1]], dt=1.0)
PLANES = np.vstack([np.eye(2), -np.eye(2)])
AT_REST = Terminal(set=(PLANES, np.zeros(4)))
AT_A_POINT = Terminal(set=(PLANES, [0.3, 0.1, -0.3, -0.1]))
AT_A_TIP = Terminal(set=([[1, 0.5], [0, 1], [-1, -1]], [0, 0, 0]))
ON_A_LINE = Terminal(set=([[1, 2], [-1, -2]], [0.3, -0.3]))

ENDS: dict[str, tuple[LinearModel, Terminal, dict[str, Any]]] = {
    "at rest": (SLIDER, AT_REST, {}),
    "at rest, with no input left to choose": (SLIDER, AT_REST, {"horizon": 2}),
    "on a line": (SLIDER, ON_A_LINE, {}),
    "at the tip of three half-spaces": (SLIDER, AT_A_TIP, {}),
    "at a point, two inputs": (MIXER, AT_A_POINT, {"horizon": 3}),
    "at a point, soft bounds": (
        MIXER, AT_A_POINT, {"horizon": 3, "soft": SoftBounds(x=0.5, penalty=500.0)},
    ),
    "at rest, an unstable plant": (FAST, AT_REST, {"horizon": 4}),
}  # fmt: skip


@pytest.mark.parametrize("name", ENDS)
def test_both_laws_hold_a_final_state_as_a_program_with_all_states_does(name: str) -> None:
    model, terminal, changes = ENDS[name]
    given: dict[str, Any] = {"Q": np.diag([1, 0.5]), "R": 0.2 * np.eye(model.n_inputs)}
    given |= {"horizon": 6, "x_min": -3, "x_max": 4, "u_min": -1, "u_max": 1.5}
    mpc = LinearMPC(model, **{**given, **changes}, terminal=terminal)
    law = mpc.law()
    assert isinstance(law, PiecewiseAffine)
    points = box_points(mpc, 400, seed=5) * np.geomspace(0.02, 1, 400)[:, None]
    inputs, feasible = online_answers(mpc, points)
    assert feasible.sum() > 20
    np.testing.assert_array_equal(law.in_domain(points), feasible)
    assert relative_error(mpc, law(points[feasible]), inputs) < 1e-9
    assert relative_error(mpc, mpc.online()(points[feasible]), inputs) < 1e-9


def test_an_equality_that_leaves_theta_a_line_is_refused_with_what_to_do() -> None:
    mpc = LinearMPC(
        SLIDER, Q=np.eye(2), R=[[1]], horizon=1, x_min=-3, x_max=3, u_min=-1, u_max=1,
        terminal=AT_REST,
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"infeasible: .* lengthen the horizon.*online\(\)"):
        mpc.explicit()
