"""Small plants that a policy can be improved on, and settings that make it quick."""

from functools import cache, partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DDPG

from sb3_yann import LinearModel, LinearMPC, plan
from sb3_yann.improvement import imitation, simulator
from sb3_yann.twin import plant_twin
from sb3_yann.twin.selection import fit_ensemble
from sb3_yann_envs import ProblemBox
from twin_samples import DT, Cart, problem

FEW = {"n_starts": 6, "rounds": 1, "updates": 200}


def quick(patch: pytest.MonkeyPatch) -> None:
    """Let fits be short."""
    patch.setattr(simulator, "fit_ensemble", partial(fit_ensemble, updates=300))
    patch.setattr(imitation, "FITS", 2)
    patch.setattr(imitation, "DESCENTS", 2)
    patch.setattr(imitation, "RETURNS", 512)
    patch.setattr(imitation, "RETURN_STEPS", 20)
    patch.setattr(imitation, "CRITIC_UPDATES", 20)


def quickest(patch: pytest.MonkeyPatch) -> None:
    """Let plans begin with the MPC and on bounds alone, too, and no twin be of networks."""
    quick(patch)
    patch.setattr(plan, "WEIGHTS", ())
    patch.setattr(plant_twin, "LONG_LOG", 10**9)


class Spring(Cart):
    """A cart between springs, which its model does not know."""

    stiffness = 0.2

    def __init__(self, steps: int = 20) -> None:
        super().__init__(steps)

    def after(self, place: float, speed: float, u: float) -> tuple[float, float]:
        """Return the next state."""
        pull = self.stiffness * place + 0.2 * place**2 + 0.3 * place**3
        return place + DT * speed, 0.9 * speed + DT * (2.0 * u - pull)

    def moved(self, u: np.ndarray) -> np.ndarray:
        return np.array(self.after(*self.x, float(np.clip(u, -1, 1)[0])))


class Plain(Spring):
    """The cart as its model has it."""

    def after(self, place: float, speed: float, u: float) -> tuple[float, float]:
        return place + DT * speed, 0.95 * speed + DT * u


POINT = np.array([5.0, 0.3])
PUSH = np.array([2.0])
"""Where the cart rests elsewhere, in plant units: its state and its input."""


@cache
def moved() -> LinearMPC:
    """Return the cart's MPC at an operating point."""
    plain = problem()
    model = LinearModel(plain.model.A, plain.model.B, DT, x_ss=POINT, u_ss=PUSH)
    return LinearMPC(
        model, Q=plain.Q, R=plain.R, horizon=3, u_min=PUSH - 1, u_max=PUSH + 1,
        theta_min=POINT - 3, theta_max=POINT + 3,
    )  # fmt: skip


class Elsewhere(Spring):
    """The spring at that operating point: it shows and takes plant units."""

    def __init__(self) -> None:
        super().__init__()
        low = np.float32(POINT - 3)
        high = np.float32(POINT + 3)
        self.observation_space = ProblemBox(low, high, problem=moved())
        self.action_space = gym.spaces.Box(np.float32(PUSH - 1), np.float32(PUSH + 1))

    def shown(self) -> np.ndarray:
        return (self.x + POINT).astype(np.float32)

    def step(self, action: Any) -> Any:
        return super().step(np.asarray(action, float) - PUSH)


class Counted(Spring):
    """Counts all steps of all copies, all that are made and all that are closed."""

    steps = made = closed = 0

    def __init__(self) -> None:
        super().__init__()
        Counted.made += 1

    def step(self, action: Any) -> Any:
        Counted.steps += 1
        return super().step(action)

    def close(self) -> None:
        Counted.closed += 1

    @classmethod
    def forget(cls) -> None:
        """Begin at zero."""
        cls.steps = cls.made = cls.closed = 0


def model_of(make: Any = Spring, kind: Any = DDPG, **policy_kwargs: Any) -> Any:
    """Return an untrained model of a plant."""
    return kind("YannPolicy", make(), device="cpu", seed=0, policy_kwargs=policy_kwargs)


def bits(owner: Any) -> dict[str, bytes]:
    """Return all weights of a model's policy, bit for bit."""
    state = owner.policy.state_dict()
    return {name: each.cpu().numpy().tobytes() for name, each in state.items()}
