"""What there is to gain is the same in the plant's own units; what is misread is refused."""

from __future__ import annotations

import numpy as np
import pytest

import unit_samples as units
from sb3_yann import LinearMPC, Tracking, headroom
from sb3_yann.audit.in_deviations import in_deviations
from sb3_yann.wrappers import SetPoint, StageCost

MPC = units.plant_mpc()


def tracking() -> LinearMPC:
    """Return an MPC of the same plant whose temperature follows a set-point."""
    design = {"Q": np.diag([1, 0]), "R": [[0.1]], "horizon": 3}
    return LinearMPC(units.MODEL, **design, **units.LIMITS, tracking=Tracking([0], 349, 351))


def test_a_plant_in_its_own_units_has_the_headroom_of_its_deviations() -> None:
    make = in_deviations(lambda: units.plant("plant", "plant"), MPC)
    plain = headroom(MPC.deviations, make, n_starts=3)
    shown = StageCost(units.plant("plant", "plant"), MPC)
    found = headroom(MPC, shown, n_starts=3)
    np.testing.assert_allclose(found.mpc_costs, plain.mpc_costs, rtol=1e-9)
    np.testing.assert_allclose(found.best_costs, plain.best_costs, rtol=1e-6)
    assert found.mpc_costs.max() < 10 and found.verdict == "keep the MPC"


@pytest.mark.parametrize(
    ("shows", "takes", "message"),
    [
        ("plant", "normalized", r"normalized inputs, from \[-1.*RescaleAction"),
        ("deviation", "deviation", r"takes deviations, from \[-2.*plant units"),
        ("deviation", "plant", "temperature = .* is shown.* this is a deviation"),
    ],
)
def test_other_units_are_refused(shows, takes, message) -> None:
    with pytest.raises(ValueError, match=message):
        headroom(MPC, units.plant(shows, takes), n_starts=2)


@pytest.mark.parametrize("low", [-1, 353])
def test_set_points_that_are_not_the_problem_s_are_named(low) -> None:
    plant = SetPoint(units.plant("plant", "plant"), low, low + 2)
    with pytest.raises(
        ValueError,
        match=r"set-point of temperature (= -.* is a deviation|is 35.*, and the MPC was solved)",
    ):
        headroom(tracking(), plant, n_starts=2)
