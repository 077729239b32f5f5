"""How a simulator is set, read and scaled: what is tolerated, and where it ends."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_yann import LinearModel
from sb3_yann.control.simulator import sample_time, to_vector


def box(low: Any, high: Any) -> gym.spaces.Box:
    return gym.spaces.Box(np.array(low, float), np.array(high, float), dtype=np.float64)


class Plant(gym.Env[Any, Any]):
    """A stable plant of one state, with a fault."""

    dt = 0.5

    def __init__(self, fault: str = "") -> None:
        self.observation_space = box([-4], [4])
        self.action_space = box([-1], [1])
        self.fault = fault

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.x = np.array((options or {}).get("state", [0.0]), float)
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        self.x = 0.5 * self.x + 0.25 * np.asarray(action)
        return self._seen(), 0.0, self.fault == "ends", False, {}

    def _seen(self) -> Any:
        return self.x + (self.fault == "shows another")


class Clock(Plant):
    """A plant that is pushed at one sample after a reset."""

    def __init__(self, at: int) -> None:
        super().__init__()
        self.at = at

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.t = 0
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        _, *rest = super().step(action)
        self.x = self.x + 0.1 * (self.t == self.at)
        self.t += 1
        return self._seen(), *rest


@pytest.mark.parametrize("at", [1, 2, 19])
def test_a_clock_is_noticed_whichever_of_twenty_samples_it_strikes_at(at: int) -> None:
    with pytest.raises(
        ValueError, match=r"starts anew \(a delay of the input, an actuator, a clock"
    ):
        LinearModel.from_env(Clock(at), x_ss=[0.0], u_ss=[0.0])
    LinearModel.from_env(Clock(20), x_ss=[0.0], u_ss=[0.0])


class Strict(Plant):
    """A plant that is cut, or ends, after each step, and takes none until it is reset."""

    def __init__(self, ends: bool) -> None:
        super().__init__()
        self.ends = ends
        self.done = False

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.done = False
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        if self.done:
            raise RuntimeError("step after the end")
        seen, reward, *_ = super().step(action)
        self.done = True
        return seen, reward, self.ends, not self.ends, {}


@pytest.mark.parametrize("ends", [True, False])
def test_an_episode_that_is_over_is_begun_anew_before_its_state_is_set(ends: bool) -> None:
    def put(env: Strict, x: Any) -> None:
        env.x = np.array(x)

    model = LinearModel.from_env(
        Strict(ends), x_ss=[0.0], u_ss=[0.0], set_state=put, get_state=lambda env: env.x
    )
    np.testing.assert_allclose([model.A, model.B], [[[0.5]], [[0.25]]], atol=1e-9)
    assert any("terminates the episode" in note for note in model.notes) == ends


def test_the_notes_tell_what_was_solved_for_and_what_is_observed() -> None:
    model = LinearModel.from_env(Plant(), x_ss=[np.nan], u_ss=[0.4])
    assert model.x_ss == pytest.approx([0.2])
    assert any(
        "Of the 2 entries of the operating point, 1 were solved for" in n for n in model.notes
    )
    assert not any("observation is not this state" in n or "terminates" in n for n in model.notes)
    shown = LinearModel.from_env(
        Plant("shows another"), x_ss=[0.0], u_ss=[0.0], get_state=lambda env: env.x
    )
    assert any("The observation is not this state." in n for n in shown.notes)
    ends = LinearModel.from_env(Plant("ends"), x_ss=[0.0], u_ss=[0.0])
    assert any("terminates the episode at the operating point" in n for n in ends.notes)
    assert model.dt == 0.5 and model.n_disturbances == 0


def test_without_a_state_the_input_in_the_middle_is_held_and_with_one_that_which_holds_it() -> None:
    plant = Plant()
    plant.action_space = box([-1], [3])
    model = LinearModel.from_env(plant)
    assert model.u_ss == pytest.approx([1.0]) and model.x_ss == pytest.approx([0.5])
    held = LinearModel.from_env(plant, x_ss=[0.25])
    assert held.u_ss == pytest.approx([0.5]) and held.x_ss == pytest.approx([0.25])


def test_the_time_of_a_step_is_given_or_the_plant_s_own() -> None:
    assert sample_time(Plant(), None) == 0.5 and sample_time(Plant(), 2) == 2.0
    for name, value in (("tau", 0.25), ("DT", np.float32(0.125))):
        plant = Plant()
        plant.dt = 0.0  # none
        setattr(plant, name, value)
        assert sample_time(plant, None) == value
    plant = Plant()
    plant.dt = np.inf
    with pytest.raises(ValueError, match="Plant has no dt, tau or DT to take it from"):
        sample_time(plant, None)


def test_a_vector_of_numbers_is_a_state_and_words_are_none() -> None:
    assert to_vector([1, 2]).tolist() == [1.0, 2.0] and to_vector(["a"]) is None
