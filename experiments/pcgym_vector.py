"""The offset-free cases of PC-Gym as arrays: the guard plays a hundred episodes at a time.

They show and pay what `pcgym.Case.taught` does, whose wrappers take one env each.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

if TYPE_CHECKING:
    from experiments.pcgym import Case


def registered(name: str) -> str:
    """Return the id of a case, which steps as one env and as many."""
    env_id = f"PCGymOffsetFree-{name}-v0"
    if env_id not in gym.registry:
        gym.register(
            env_id,
            entry_point=lambda: _case(name).taught(),
            vector_entry_point=lambda num_envs: CaseVectorEnv(name, num_envs),
        )
    return env_id


@lru_cache
def _case(name: str) -> Case:
    from experiments.pcgym import Case

    return Case(name, offset_free=True)


class CaseVectorEnv(VectorEnv[Any, Any, Any]):
    """As many copies of a case, whose episodes have one length and begin together."""

    metadata = {"autoreset_mode": AutoresetMode.DISABLED, "seeds_each": True}

    def __init__(self, name: str, num_envs: int) -> None:
        self.case, self.num_envs = _case(name), num_envs
        self.one = self.case.taught()
        self.single_observation_space = self.one.observation_space
        self.single_action_space = self.one.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Any = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin all episodes, each from its own seed."""
        if not isinstance(seed, Sequence) or len(seed) != self.num_envs or options:
            raise ValueError(f"seed = {seed!r} must be {self.num_envs} seeds, without options.")
        plant = self.case.plant
        self.wanted = np.array([(plant.reset(seed=each), plant.wanted)[1] for each in seed])
        self.x = np.tile(plant.x0, (self.num_envs, 1))
        self.taken, self.estimate = 0, np.zeros((self.num_envs, 0))
        self.theta = self._shown(None)
        return self.theta, {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all; the rewards are minus the stage costs."""
        plant, mpc, space = self.case.plant, self.case.mpc, self.single_action_space
        u = np.clip(np.asarray(actions, np.float64), space.low, space.high)
        costs = mpc.stage_cost(self.theta.astype(np.float64), u)
        self.x = plant.advance(self.x, np.clip(u, plant.u_min, plant.u_max))
        self.taken += 1
        self.theta = self._shown(u)
        over = np.full(self.num_envs, self.taken >= len(plant.schedule) - 1)
        return self.theta, -costs, np.zeros_like(over), over, {}

    def _shown(self, u: Any) -> Any:
        """Return theta (num_envs, n_theta) after inputs u, None at the start."""
        case, observer = self.case, self.case.observer
        assert observer is not None
        seen = np.concatenate([self.x, self.wanted[:, self.taken]], axis=1).astype(np.float32)
        y, r = np.split(seen, [observer.n_measured], axis=1)
        units, n = case.mpc.units, case.mpc.model.n_states
        y = units.to_deviations(y)
        if u is None:
            start = y @ np.linalg.pinv(observer.C).T
            self.estimate = np.hstack([start, np.zeros((len(y), case.mpc.model.n_disturbances))])
        else:
            u = units.input_to_deviations(u)
            predicted = self.estimate @ observer.A.T + u @ observer.B.T
            self.estimate = predicted + (y - predicted @ observer.seen.T) @ observer.gain.T
        d = np.clip(self.estimate[:, n:], *self.bounds)
        shown = np.hstack([units.to_plant(self.estimate[:, :n]), r, d]).astype(np.float32)
        inside = self.one.get_wrapper_attr("_inside")
        rounded = self.one.get_wrapper_attr("_rounded")
        for bound, within in zip(rounded, inside, strict=True):
            np.copyto(shown[:, -d.shape[1] :], within, where=shown[:, -d.shape[1] :] == bound)
        return shown

    @property
    def bounds(self) -> tuple[Any, Any]:
        """Lowest and highest disturbances that are shown."""
        return self.case.mpc.disturbances.d_min, self.case.mpc.disturbances.d_max
