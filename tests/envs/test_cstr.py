"""The reactor: its equations, its model, its limit, and how an episode starts and ends."""

from typing import Any

import control
import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from sb3_yann_envs import cstr
from sb3_yann_envs.cstr import CSTREnv

# Entries of the printed A that the true equations do not have, with the true values.
NOT_REPRODUCED = {
    (0, 1): -0.0047,
    (0, 3): -0.0003,
    (1, 3): -0.0003,
    (2, 2): 0.9990,
    (3, 2): 0.0002,
    (3, 3): 1.0029,
}


def act(u: float) -> NDArray[np.float32]:
    return np.array([u], dtype=np.float32)


def started(state: Any = (0.0, 0.0, 0.0, 0.0)) -> CSTREnv:
    env = CSTREnv()
    env.reset(options={"state": state})
    return env


def test_one_step_gives_the_reference_value() -> None:
    # From an independent implementation of the same equations, given to nine decimals.
    env = started([0.03, 0.3, -0.2, 3.0])
    *_, info = env.step(act(-55.0))
    expected = [0.111143870, 1.180869959, 2.794950099, 478.109431754]
    np.testing.assert_allclose(info["state"] + cstr.X_SS, expected, rtol=0, atol=1e-8)


def test_the_steady_state_is_the_published_one() -> None:
    expected = [0.08616063, 0.88616063, 2.99475999, 475.0]
    np.testing.assert_allclose(cstr.X_SS, expected, rtol=0, atol=5e-9)
    assert cstr.FEED_TEMPERATURE == pytest.approx(452.48303, abs=5e-6)


@pytest.mark.parametrize("u", [-55.0, 0.0, 55.0])
@pytest.mark.parametrize(
    "state",
    [(0.05, 0.4, 0.4, 4.0), (-0.05, -0.4, -0.4, -7.5), (0.05, 0.4, 0.4, 4.99), (0.1, 0.4, 0, 5.0)],
)
def test_a_step_agrees_with_an_accurate_integrator(state: tuple[float, ...], u: float) -> None:
    *_, info = started(state).step(act(u))
    exact = solve_ivp(
        lambda t, x: cstr.dynamics(x, cstr.U_SS + u),
        (0.0, cstr.DT),
        cstr.X_SS + state,
        method="Radau",
        rtol=1e-12,
        atol=1e-14,
    )
    np.testing.assert_allclose(info["state"] + cstr.X_SS, exact.y[:, -1], rtol=0, atol=1e-7)


def test_the_linearized_dynamics_give_the_printed_model_but_for_six_entries() -> None:
    plant = control.nlsys(
        lambda t, x, u, params: cstr.dynamics(x, u), None, states=4, inputs=1, outputs=4
    )
    model = control.linearize(plant, cstr.X_SS, cstr.U_SS).sample(cstr.DT, method="zoh")
    expected = cstr.PRINTED_A.copy()
    for at, value in NOT_REPRODUCED.items():
        assert expected[at] != value
        expected[at] = value
    np.testing.assert_array_equal(np.round(model.A, 4), expected)
    np.testing.assert_array_equal(np.round(model.B, 4), cstr.PRINTED_B)


@pytest.mark.parametrize("seed", range(10))
def test_without_cooling_every_start_ends_beyond_the_limit_and_is_fined_once(seed: int) -> None:
    env = CSTREnv()
    env.reset(seed=seed)
    infos = []
    terminated = False
    while not terminated:
        observation, reward, terminated, truncated, info = env.step(act(-55.0))
        assert (info["violation"], truncated) == (terminated, False)
        assert terminated == (info["state"][3] > 5.0)
        infos.append(info)
    assert observation in env.observation_space
    assert reward == -infos[-1]["cost"] < -cstr.PENALTY
    assert sum(info["cost"] >= cstr.PENALTY for info in infos) == 1
    assert infos[-1]["cost"] - cstr.PENALTY < 10.0


def test_a_terminated_episode_cannot_be_continued() -> None:
    env = started([0.05, 0.4, 0.4, 5.0])
    *_, terminated, _, _ = env.step(act(-55.0))
    assert terminated
    with pytest.raises(gymnasium.error.ResetNeeded, match="passed its temperature limit"):
        env.step(act(0.0))
    env.reset()
    env.step(act(0.0))


def test_one_step_from_the_limit_with_all_concentrations_at_their_bounds_stays_in_the_space() -> (
    None
):
    # Heat release grows with every concentration, so no other step ends hotter.
    high = np.asarray(CSTREnv().observation_space.high, dtype=np.float64)  # type: ignore[attr-defined]
    worst = np.append(cstr.X_SS[:3] + high[:3], cstr.TEMPERATURE_LIMIT)
    end = solve_ivp(
        lambda t, x: cstr.dynamics(x, np.zeros(1)),
        (0.0, cstr.DT),
        worst,
        method="Radau",
        rtol=1e-10,
    )
    assert end.y[3].max() - cstr.X_SS[3] < high[3]


def test_a_chosen_start_is_taken_exactly() -> None:
    start = [0.01, -0.2, 0.3, -1.7]
    observation, info = CSTREnv().reset(options={"state": start})
    np.testing.assert_array_equal(info["state"], start)
    np.testing.assert_array_equal(observation, np.array(start, dtype=np.float32))


def test_a_state_handed_out_continues_the_same_trajectory_bit_for_bit() -> None:
    env = CSTREnv()
    env.reset(seed=2)
    for _ in range(7):
        *_, info = env.step(act(-12.3))
    twin = started(info["state"])
    for _ in range(20):
        *_, ours = env.step(act(21.0))
        *_, theirs = twin.step(act(21.0))
        np.testing.assert_array_equal(ours["state"], theirs["state"])
