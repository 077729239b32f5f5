"""An episode that ends sooner is worse, unless its end is a success."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_yann import LinearModel, LinearMPC
from sb3_yann.rollout import rollout

MPC = LinearMPC(LinearModel([[1.0]], [[1.0]], 1.0), Q=[[1]], R=[[1]], horizon=2, x_min=-4, x_max=4,
                u_min=-1, u_max=1)  # fmt: skip


class Dock(gym.Env[Any, Any]):
    """It ends at zero, or at four, in time or after ten steps."""

    observation_space = gym.spaces.Box(-9, 9, (1,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float64)

    def __init__(self, tells: bool) -> None:
        self.tells = tells

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin at two."""
        super().reset(seed=seed)
        self.x = np.array([2.0])
        self.k = 0
        return self.x.copy(), {}

    def step(self, action: Any) -> Any:
        """Move."""
        self.x = self.x + action
        self.k += 1
        docked = bool(abs(self.x[0]) < 0.1)
        info = {"is_success": docked} if self.tells else {}
        return self.x.copy(), 0.0, docked or self.x[0] > 3.9, self.k == 10, info


def moving(u: float) -> Any:
    return lambda t, theta, rows: np.full((len(theta), 1), u)


@pytest.mark.parametrize(("tells", "u", "fine"), [(True, -1, 1), (False, -1, 0), (True, 1, 0)])
def test_only_a_success_may_end_sooner(tells, u, fine) -> None:
    slow, quick = (
        rollout(moving(each), lambda: Dock(tells), [0], problem=MPC) for each in (0.0, u)
    )
    assert quick.lengths < slow.lengths
    assert quick.no_worse(slow)[0] == bool(fine)
    assert slow.no_worse(quick)[0]
