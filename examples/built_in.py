"""A built-in environment of Gymnasium, linearized by its own simulator, from its MPC onward.

python examples/built_in.py [--episodes 30] [--seed 0]
"""

import argparse
from pathlib import Path

import gymnasium
import numpy as np
import torch
from rich.console import Console
from stable_baselines3 import DDPG

from sb3_yann import CostAudit, ImprovementGuard, LinearModel, LinearMPC, NoActionNoise, YannPolicy
from sb3_yann.evaluation import comparison_table, evaluate, plots

TEST_SEEDS = range(2000, 2050)  # starts that training never sees


class NearUpright(gymnasium.ObservationWrapper):
    """Pendulum-v1 from starts near upright, seen as its state: angle and speed."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        top = np.array([np.pi, 8.0])
        self.observation_space = gymnasium.spaces.Box(-top, top, dtype=np.float64)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        """Start within 0.5 rad and 0.8 rad/s of upright and at rest."""
        return super().reset(seed=seed, options={"x_init": 0.5, "y_init": 0.8})

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """Return angle and speed; Gymnasium shows cosine and sine of the angle."""
        cosine, sine, speed = observation.astype(float)
        return np.array([np.arctan2(sine, cosine), speed])


def make_env() -> gymnasium.Env:
    """Return the environment; its reward is its own."""
    return NearUpright(gymnasium.make("Pendulum-v1"))


def main() -> None:
    """Linearize, design, check, train, and compare the policy with the MPC that it was."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # the networks are too small to share among cores
    console = Console(highlight=False)

    plant = LinearModel.from_env(make_env, x_ss=[0, 0], u_ss=[0]).named(time_unit="s")
    console.print(plant.report())
    cost = {"Q": np.diag([1.0, 0.1]), "R": [[0.001]]}  # what Gymnasium's documentation says
    limits = {"x_min": [-2, -8], "x_max": [2, 8], "u_min": -2, "u_max": 2}
    mpc = LinearMPC(plant, **cost, horizon=2, **limits, infeasible="zero_input")

    settings = {"seed": arguments.seed, "device": "cpu", "policy_kwargs": {"problem": mpc}}
    model = DDPG(YannPolicy, make_env(), **settings)
    before = evaluate(model, make_env, TEST_SEEDS)
    guard = ImprovementGuard(make_env)
    callbacks = [NoActionNoise(), CostAudit(verbose=1), guard]
    model.learn(200 * arguments.episodes, callback=callbacks, progress_bar=True)
    after = evaluate(model, make_env, TEST_SEEDS)

    print(comparison_table("Cost of 50 unseen starts, Pendulum-v1", before, after))
    runs = {"before (linear MPC)": before, "after training": after}
    Path("out").mkdir(exist_ok=True)
    plots.loops_figure(mpc, runs).savefig("out/built_in.png")
    console.print("Picture: out/built_in.png")


if __name__ == "__main__":
    main()
