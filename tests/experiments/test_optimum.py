"""The optimum of both plants: what the plans cost in the environment, and that they are optimal."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from scipy.optimize import minimize

from experiments import optimum
from sb3_yann_envs import clipped_pendulum, cstr, problems

STEPS = 60
PLANTS = {
    "CSTR-v0": (
        optimum.cstr_plan,
        optimum.cstr_optimum,
        problems.cstr,
        cstr.MAX_INPUT,
        [[0.03, 0.3, -0.2, 3.0], [-0.02, -0.4, 0.4, -7.0], [0.0, 0.0, 0.0, 0.0]],
    ),
    "ClippedPendulum-v0": (
        optimum.clipped_pendulum_plan,
        optimum.clipped_pendulum_optimum,
        problems.clipped_pendulum,
        clipped_pendulum.MAX_TORQUE,
        [[0.1, 0.3], [0.45, 0.4], [0.0, 0.0]],
    ),
}


def charged(env_id, start, inputs):
    """Return the environment's cost of inputs (steps,), or of a law."""
    env = gymnasium.make(env_id).unwrapped
    state, _ = env.reset(options={"state": start})
    total = 0.0
    for t in range(STEPS if callable(inputs) else len(inputs)):
        action = inputs(state.astype(float)) if callable(inputs) else inputs[t : t + 1]
        state, _, _, _, info = env.step(action)
        assert not info["violation"]
        total += info["cost"]
    return total


@pytest.fixture(scope="module", params=PLANTS)
def plant(request):
    plan, _, problem, max_input, starts = PLANTS[request.param]
    return request.param, problem(), max_input, np.array(starts), plan(starts, STEPS)


def test_the_environment_charges_the_cost_of_the_plan(plant) -> None:
    env_id, _, max_input, starts, plan = plant
    assert plan.inputs.shape == (len(starts), STEPS)
    assert np.all(abs(plan.inputs) <= max_input)
    played = [charged(env_id, start, u) for start, u in zip(starts, plan.inputs, strict=True)]
    np.testing.assert_array_equal(plan.costs, played)


def test_the_mpc_is_not_cheaper(plant) -> None:
    env_id, mpc, _, starts, plan = plant
    law = mpc.explicit()
    for start, cost in zip(starts[:2], plan.costs, strict=False):
        assert 0 < cost < charged(env_id, start, law)


def test_no_change_of_an_input_makes_it_cheaper(plant) -> None:
    # Differences of the environment's own cost; the pendulum's early torques are left out, whose
    # effect grows so much that no difference is both accurate and small.
    env_id, _, max_input, starts, plan = plant
    assert plan.residual[0] < 1e-6
    for t in (30, 40, 50, 58):
        for sign in (-1, 1):
            changed = plan.inputs[0].copy()
            changed[t] = np.clip(changed[t] + sign * 1e-3 * max_input, -max_input, max_input)
            assert charged(env_id, starts[0], changed) >= plan.costs[0] - 1e-12


@pytest.mark.parametrize(
    ("env_id", "start"),
    [("CSTR-v0", [0.03, 0.3, -0.2, 3.0]), ("ClippedPendulum-v0", [0.2, -0.1])],
)
def test_a_general_optimizer_finds_the_same_cost(env_id, start) -> None:
    # Few steps: L-BFGS-B with differences of the environment's cost, from no input at all.
    _, optimal, _, max_input, _ = PLANTS[env_id]
    found = minimize(
        lambda u: charged(env_id, start, max_input * u),
        np.zeros(8),
        method="L-BFGS-B",
        bounds=[(-1, 1)] * 8,
        options={"ftol": 1e-14, "gtol": 1e-9},
    )
    np.testing.assert_allclose(optimal([start], 8), found.fun, rtol=1e-6)


def test_the_pendulum_swings_round_where_it_cannot_be_held() -> None:
    held, swung = optimum.clipped_pendulum_optimum([[0.3, 0.0], [0.5, 0.8]], steps=100)
    assert held < 5
    assert 120 < swung < 127


def test_the_temperature_limit_counts() -> None:
    # One start can be cooled in time, the other cannot.
    cooled, lost = optimum.cstr_optimum([[0.05, 0.4, 0.4, 4.0], [0.1, 0.4, 0.4, 4.5]], STEPS)
    assert np.isfinite(cooled)
    assert lost == np.inf
