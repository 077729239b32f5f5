"""The yardsticks start where they claim to, and optima are those of the plants."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.optimize import minimize

from experiments import optimum
from experiments.yardsticks import residual_rl
from sb3_yann_envs import clipped_pendulum, cstr, problems

ENVS = ["CSTR-v0", "ClippedPendulum-v0"]


def random_states(env: gym.Env, count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(0)
    space = env.observation_space
    return rng.uniform(space.low, space.high, (count, *space.shape)).astype(np.float32)


@pytest.mark.parametrize("env_id", ENVS)
def test_the_residual_policy_is_the_mpc_before_training(env_id) -> None:
    env = gym.make(env_id)
    learner = residual_rl(lambda: env, 0)
    states = random_states(env)
    expected = env.observation_space.problem.explicit()(states).astype(np.float32)
    np.testing.assert_array_equal(learner.policy.predict(states)[0], expected)
    np.testing.assert_array_equal(learner.policy.predict(states[0])[0], expected[0])


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
    env = gym.make(env_id).unwrapped
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


@pytest.mark.parametrize(
    ("env_id", "start"), [("CSTR-v0", [0.03, 0.3, -0.2, 3.0]), ("ClippedPendulum-v0", [0.2, -0.1])]
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


def test_the_temperature_limit_counts() -> None:
    # One start can be cooled in time, the other cannot.
    cooled, lost = optimum.cstr_optimum([[0.05, 0.4, 0.4, 4.0], [0.1, 0.4, 0.4, 4.5]], STEPS)
    assert np.isfinite(cooled)
    assert lost == np.inf
