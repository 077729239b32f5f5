"""Where bounds are kept, `improve` keeps as far from them as the MPC's model errs in a step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stable_baselines3 import DDPG

from sb3_yann import PlantTwin, YannPolicy
from sb3_yann.improvement.improving import _Progress, _Work
from sb3_yann.improvement.model import one_step_error
from twin_samples import POLYNOMIALS, Cart, log, problem


def bounded() -> PlantTwin:
    """The cart's twin, whose MPC knows a bound on its speed."""
    mpc = replace(problem(), x_min=[-np.inf, -1.0], x_max=[np.inf, 1.0], terminal=None)
    return PlantTwin.fit(mpc, log(4), residuals=POLYNOMIALS)


def test_the_error_is_what_ninety_five_per_cent_of_the_steps_keep() -> None:
    twin = bounded()
    steps = [(x[:-1], u, x[1:]) for x, u in log(4)]
    model, half = twin.problem.model, np.array([3.0, 3.0])
    errors = [np.abs(after - x @ model.A.T - u @ model.B.T) / half for x, u, after in steps]
    expected = np.quantile(np.concatenate(errors).max(axis=1), 0.95)
    assert one_step_error(twin.dynamics.row, twin.episodes) == pytest.approx(expected)


@pytest.mark.parametrize("given", [0.0, 0.3])
def test_an_accepted_policy_has_that_margin_unless_another_was_given(given: float) -> None:
    twin = bounded()
    options = {"problem": twin.problem, "bounds_margin": given}
    model = DDPG(YannPolicy, Cart(), device="cpu", seed=0, policy_kwargs=options)
    work = _Work(model.policy, 4, 1, 10, 0, _Progress(False, 1))
    work.keep_margin(twin.dynamics.row, twin.episodes)
    work.accept(twin)
    error = one_step_error(twin.dynamics.row, twin.episodes)
    assert 1e-3 < error < 0.1
    assert model.policy.bounds_margin == pytest.approx(given or error)
    assert float(model.policy.actor_target.mu.margin) == model.policy.bounds_margin
