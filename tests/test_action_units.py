"""Plant units and deviations: what an env takes follows from its bounds; deviations are named."""

from dataclasses import replace

import numpy as np
import pytest

from sb3_yann import LinearModel, LinearMPC
from sb3_yann.units import ActionUnits

MODEL = LinearModel(np.eye(2) / 2, np.eye(2), 1.0, x_ss=[1, 0], u_ss=[300, -2])
MPC = LinearMPC(
    MODEL, Q=np.eye(2), R=np.eye(2), horizon=1, x_min=[-1, -2], x_max=[3, 2], u_min=[299, -5],
    u_max=[302, 3],
)  # fmt: skip
BOUNDS = {"plant": ([299, -5], [302, 3]), "normalized": ([-1, -1], [1, 1])}


@pytest.mark.parametrize("kind", BOUNDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_bounds_tell_what_an_env_takes(kind: str, dtype: type) -> None:
    low, high = (np.array(side, dtype) for side in BOUNDS[kind])
    units = ActionUnits.of(MPC, low, high)
    own = MPC.deviations
    assert units is not None and units.kind == kind
    np.testing.assert_allclose(units.input([low, high]), [own.u_min, own.u_max], atol=1e-12)
    u = np.random.default_rng(0).uniform(own.u_min, own.u_max, (9, 2))
    np.testing.assert_allclose(units.input(units.action(u)), u, atol=1e-12)


COLD = LinearMPC(
    replace(MODEL, x_ss=[1, -30]), Q=np.eye(2), R=np.eye(2), horizon=1, x_min=[-1, -32],
    x_max=[3, -28], u_min=[299, -5], u_max=[302, 3],
)  # fmt: skip


@pytest.mark.parametrize(
    "shown", [[0, 0], [2.5, 9], [1, 0]], ids=["inside", "outside anyway", "at rest"]
)
def test_plant_units_are_not_taken_for_deviations(shown: list[float]) -> None:
    assert MPC.shown_as_deviation(np.array([shown])) == ""


def test_the_state_that_lies_at_zero_is_found() -> None:
    assert COLD.shown_as_deviation(np.array([[0.2, -0.5], [-0.2, 1]])).startswith("x[1] = -0.5 is")
    assert COLD.shown_as_deviation(np.array([[1.2, -30.5]])) == ""
    assert COLD.shown_as_deviation(np.zeros((0, 2))) == ""
