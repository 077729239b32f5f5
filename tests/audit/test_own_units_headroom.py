"""What there is to gain is the same in the plant's own units; what is misread is refused."""

from __future__ import annotations

import numpy as np
import pytest

import unit_samples as units
from sb3_yann import headroom
from sb3_yann.wrappers import Deviations, StageCost

MPC = units.absolute_mpc()


def test_a_plant_in_its_own_units_has_the_headroom_of_its_deviations() -> None:
    plain = headroom(MPC, Deviations(units.plant("absolute", "absolute"), MPC), n_starts=3)
    shown = StageCost(units.plant("absolute", "absolute"), MPC)
    found = headroom(MPC, shown, n_starts=3)
    np.testing.assert_allclose(found.mpc_costs, plain.mpc_costs, rtol=1e-9)
    np.testing.assert_allclose(found.best_costs, plain.best_costs, rtol=1e-6)
    assert found.mpc_costs.max() < 10 and found.verdict == "do not bother"


@pytest.mark.parametrize(
    ("takes", "mpc", "message"),
    [
        ("absolute", units.deviation_mpc(), r"absolute inputs, from \[38.*Wrap.*Deviations"),
        ("normalized", MPC, r"normalized inputs, from \[-1.*RescaleAction"),
        ("deviation", MPC, "shows state 'temperature' = 350.*Deviations"),
    ],
)
def test_units_that_nobody_can_tell_are_refused(takes, mpc, message) -> None:
    with pytest.raises(ValueError, match=message):
        headroom(mpc, units.plant("absolute", takes), n_starts=2)
