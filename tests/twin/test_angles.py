"""An angle that is shown between -pi and pi jumps by a full turn: the model does not."""

import numpy as np
import pytest

from sb3_yann import LinearModel, LinearMPC
from sb3_yann.twin.dynamics import Coordinates, Dynamics
from sb3_yann.twin.ensemble import fit_ensemble
from sb3_yann.twin.log import Episode

DT = 0.1


def rotor() -> LinearMPC:
    model = LinearModel([[1.0, DT], [0.0, 1.0]], [[0.0], [DT]], DT)
    return LinearMPC(model, Q=np.eye(2), R=[[1.0]], horizon=2, u_min=-1, u_max=1)


def episodes(turn: float, low: float) -> list[Episode]:
    """Return episodes of a rotor with a little friction, its angle shown from ``low`` on."""
    rng, found = np.random.default_rng(0), []
    for _ in range(6):
        x = np.array([turn * rng.uniform(), rng.uniform(-1, 1) * turn / 4])
        thetas, inputs = [], rng.uniform(-1, 1, (60, 1))
        for u in [*inputs, [0.0]]:
            thetas.append([low + (x[0] - low) % turn, x[1]])
            x = x + DT * np.array([x[1], u[0] - 0.1 * x[1]])
        found.append(Episode(np.array(thetas), inputs))
    return found


@pytest.mark.parametrize(("turn", "low"), [(2 * np.pi, -np.pi), (2 * np.pi, 0.0), (360.0, -180.0)])
def test_a_wrapped_angle_is_found_and_its_jumps_are_not_learnt(turn, low) -> None:
    mpc, log = rotor(), episodes(turn, low)
    coordinates = Coordinates.of(mpc, log)
    np.testing.assert_allclose(coordinates.turn, [turn, 0.0])
    (network,) = fit_ensemble(coordinates, [log], 0, updates=500)
    model = Dynamics(mpc, coordinates, (network,))
    for each in log:
        after = model.step(each.thetas[None, :-1], each.actions[None])[0]
        error = coordinates.nearest(after, each.thetas[1:]) - each.thetas[1:]
        assert np.abs(error).max() < 2e-3 * turn
        assert np.ptp(after[:, 0]) <= 1.001 * turn


def test_a_state_that_does_not_jump_is_no_angle() -> None:
    log = episodes(2 * np.pi, -np.pi)
    calm = [Episode(np.unwrap(e.thetas, axis=0), e.actions) for e in log]
    assert Coordinates.of(rotor(), calm).turn is None
    # A sensor that falls to zero now and then is none either.
    for each in calm:
        each.thetas[::7, 0] = 0.0
    assert Coordinates.of(rotor(), calm).turn is None
