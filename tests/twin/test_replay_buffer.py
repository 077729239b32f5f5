"""What episodes a replay buffer holds, row by row."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_yann import LinearModel, LinearMPC
from sb3_yann.twin.replay_buffer import episodes_of, normalization_of

MPC = LinearMPC(
    LinearModel([[0.9]], [[1.0]], 1.0), Q=[[1]], R=[[1]], horizon=2, u_min=-1, u_max=3,
    theta_min=-99, theta_max=99,
)  # fmt: skip


class Model:
    """A model whose buffer holds numbered observations; the policy's theta is ten times those."""

    def __init__(self, now: Any, after: Any, dones: Any = (), size: int = 40) -> None:
        now, after = (np.array(each, np.float32).reshape(len(now), -1) for each in (now, after))
        rows, envs = now.shape
        ends = np.zeros((rows, envs), np.float32)
        ends[list(dones)] = 1.0
        self.policy = SimpleNamespace(problem=MPC, theta=lambda seen: 10 * th.as_tensor(seen))
        self.replay_buffer = SimpleNamespace(
            optimize_memory_usage=False, size=lambda: rows, full=rows == size, pos=rows % size,
            n_envs=envs, observations=now[..., None], next_observations=after[..., None],
            actions=(now[..., None] % 5) / 4 - 0.5, dones=ends,
        )  # fmt: skip
        self.normalize: Any = None

    def get_vec_normalize_env(self) -> Any:
        return self.normalize


def numbers(model: Model) -> list[list[int]]:
    """Return the observations of each episode."""
    return [np.round(thetas[:, 0] / 10).astype(int).tolist() for thetas, _ in episodes_of(model)]


def test_an_episode_ends_where_it_is_done_or_where_the_next_row_is_another_s() -> None:
    now = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 20, 21, 22, 23, 24]
    after = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 21, 22, 23, 24, 25]
    assert numbers(Model(now, after)) == [[*range(11)], [*range(20, 26)]]
    assert numbers(Model(now, after, dones=[4])) == [[*range(6)], [*range(5, 11)], [*range(20, 26)]]
    # Pieces of four steps are none.
    assert numbers(Model(now, after, dones=[3])) == [[*range(4, 11)], [*range(20, 26)]]
    assert numbers(Model(now[:14], after[:14])) == [[*range(11)]]


def test_actions_are_in_the_problem_s_units() -> None:
    ((thetas, u),) = episodes_of(Model(range(8), range(1, 9)))
    scaled = np.arange(8) % 5 / 4 - 0.5
    np.testing.assert_allclose(u[:, 0], 1 + 2 * scaled)  # of -1 to 3
    assert thetas.shape == (9, 1) and thetas.dtype == u.dtype == np.float64


def test_the_oldest_row_of_a_full_buffer_is_the_next_to_be_written_over() -> None:
    order = np.roll(np.arange(12), 5)
    full = Model(order, order + 1, size=12)
    full.replay_buffer.pos = 5
    assert numbers(full) == [[*range(13)]]
    full.replay_buffer.full = False
    assert numbers(full) == [[*range(7, 13)], [*range(8)]]


def test_each_env_has_episodes_of_its_own() -> None:
    now = np.column_stack([np.arange(6), np.arange(50, 56)])
    assert numbers(Model(now, now + 1)) == [[*range(7)], [*range(50, 57)]]


def test_what_a_simulator_did_is_left_out() -> None:
    model = Model(range(18), range(1, 19), dones=[5, 11])
    marks = np.zeros((40, 1), dtype=bool)
    model.replay_buffer.simulated = marks
    assert numbers(model) == [[*range(7)], [*range(6, 13)], [*range(12, 19)]]
    marks[11] = True  # one step of it is enough
    assert numbers(model) == [[*range(7)], [*range(12, 19)]]


def test_observations_pass_through_the_model_s_own_normalization() -> None:
    model = Model(range(8), range(1, 9))
    model.normalize = SimpleNamespace(normalize_obs=lambda seen: seen + 100)
    assert numbers(model) == [[*range(100, 109)]]
    assert normalization_of(model) is model.normalize
    model.sees_normalized = True
    assert normalization_of(model) is model.normalize
    model.normalize = None
    with pytest.raises(ValueError, match="Stable-Baselines3 saves its statistics apart"):
        episodes_of(model)


def test_without_an_episode_of_five_steps_there_is_none() -> None:
    assert numbers(Model(range(5), range(1, 6))) == [[*range(6)]]
    with pytest.raises(ValueError, match="holds 4 rows and no episode of 5 steps"):
        episodes_of(Model(range(4), range(1, 5)))
    with pytest.raises(TypeError, match="model must have a YannPolicy"):
        episodes_of(SimpleNamespace(policy=SimpleNamespace()))
