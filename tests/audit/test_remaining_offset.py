"""An offset that an MPC leaves is named though nothing is gained by removing it."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_yann import DisturbanceBounds, LinearModel, LinearMPC, Tracking
from sb3_yann.audit.offset import remaining_offset

MOTOR = LinearModel([[0.8]], [[0.5]], dt=1.0, state_names=["speed"], units=["rpm", ""])


def motor(**changes) -> LinearMPC:
    """Return it in deviations, as what is looked at here."""
    given = {"Q": [[1.0]], "R": [[0.1]], "horizon": 2, "u_min": -900, "u_max": 900}
    box = {"theta_min": -900, "theta_max": 900, "tracking": Tracking([0], -900, 900)}
    return LinearMPC(changes.pop("model", MOTOR), **{**given, **box, **changes})


def run(beside: float, r: float = 100.0) -> np.ndarray:
    """Return an episode that comes to rest so far beside its set-point."""
    away = beside + 300 * 0.5 ** np.arange(30)
    return np.column_stack([r + away, np.full(30, r)])


def test_it_is_named_in_units_of_the_plant_beside_what_an_observer_leaves() -> None:
    runs, near, far = [run(79)] * 3, [run(0.5)] * 3, [run(60)] * 3
    named = "With the MPC, speed (rpm) came to rest 79 beside its set-point, 3 times. "
    assert remaining_offset(motor(), runs, near).startswith(f"{named}An observer removes that")
    dear = remaining_offset(motor(), runs, near, cost_increase=0.12)
    assert dear == f"{named}An observer removes that, but costs 12 % more: leave it out."
    left = remaining_offset(motor(), runs, far)
    assert left.startswith(f"{named}An observer leaves 60: look whether an input is at its bound")
    assert remaining_offset(motor(), near, near) == ""  # less than 1 % of the set-points' range


def test_why_no_observer_was_tried_is_said() -> None:
    runs = [run(79)] * 3
    assert "not tried: no inputs hold" in remaining_offset(motor(), runs, None)
    loaded = LinearModel([[0.8]], [[0.5]], dt=1.0, E=[[1.0]])
    measured = motor(model=loaded, disturbances=DisturbanceBounds(-1, 1))
    runs = [np.column_stack([each, np.zeros(30)]) for each in runs]
    text = remaining_offset(measured, runs, None)
    assert "the tracked output 0" not in text and "the MPC has disturbances already" in text


@pytest.mark.parametrize(("weight", "named"), [(1.0, "x[1]"), (0.0, "x[0]")])
def test_without_references_the_states_that_are_weighed_count(weight: float, named: str) -> None:
    model = LinearModel(np.eye(2) / 2, np.eye(2), dt=1.0)
    mpc = motor(model=model, Q=np.diag([1.0, weight]), R=np.eye(2), tracking=None)
    runs = [np.column_stack([run(20)[:, 0] - 100, run(50)[:, 0] - 100])] * 2
    found = remaining_offset(mpc, runs, runs)
    assert f"{named} came to rest" in found and "beside its operating point, 2 times" in found


def test_a_combination_of_states_is_called_by_its_number() -> None:
    model = LinearModel(np.eye(2) / 2, np.eye(2), dt=1.0)
    both = motor(model=model, Q=np.eye(2), R=np.eye(2), tracking=Tracking([[1, 1]], -900, 900))
    runs = [np.column_stack([run(79)[:, 0], np.zeros(30), run(79)[:, 1]])] * 2
    assert "the tracked output 0 came to rest 79" in remaining_offset(both, runs, runs)
