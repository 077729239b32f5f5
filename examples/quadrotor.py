"""DDPG on a quadrotor of twelve states and four rotors, whose MPC is solved online.

python examples/quadrotor.py [--episodes 50] [--seed 0]
"""

from __future__ import annotations

import argparse
from functools import partial

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import TimeLimit
from rich.console import Console
from stable_baselines3 import DDPG

from quadrotor_plant import DT, MAX_THRUST, STARTS, Quadrotor, derivative
from sb3_yann import ImprovementGuard, NoActionNoise, YannPolicy
from sb3_yann.control import LinearModel, LinearMPC, SoftBounds
from sb3_yann.evaluation import comparison_table, evaluate, plots
from sb3_yann.wrappers import StageCost

STEPS = 100  # of one episode: 5 s
TEST_SEEDS = range(3000, 3100)  # starts that training and guard never see
SOFT_TILT = 0.5  # rad
STATES = "x y z roll pitch yaw vx vy vz p q r".split()


def hover() -> LinearMPC:
    """Return the MPC that hovers: a second ahead, with a soft bound on the tilt."""
    model = LinearModel.from_dynamics(derivative, np.zeros(12), [np.nan] * 4, DT)
    units = [*np.repeat(["m", "rad", "m/s", "rad/s"], 3), *["N"] * 4]
    model = model.named(STATES, [f"rotor {k}" for k in range(4)], units, "s")
    tilt = np.full(12, np.inf)
    tilt[3:5] = SOFT_TILT
    soft = SoftBounds(np.where(np.isfinite(tilt), 0.1, 0.0), penalty=300.0)
    limits = {"x_min": -tilt, "x_max": tilt, "u_min": 0.0, "u_max": MAX_THRUST}
    limits |= {"theta_min": -4 * STARTS - 3, "theta_max": 4 * STARTS + 3}
    weights = {"Q": np.diag(np.repeat([10.0, 1.0, 1.0, 0.1], 3)), "R": 0.5 * np.eye(4)}
    return LinearMPC(model, **weights, horizon=20, gamma=0.99, soft=soft, **limits)


def make_env(mpc: LinearMPC) -> gymnasium.Env:
    """Return the plant, which costs what the MPC minimizes."""
    return TimeLimit(StageCost(Quadrotor(), mpc), STEPS)


def main() -> None:
    """Train, then compare the policy with the MPC that it was at the start."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # the networks are too small to share among cores
    console, mpc = Console(highlight=False), hover()
    make = partial(make_env, mpc)
    policy = {"problem": mpc, "law": "online"}
    settings = {"gamma": mpc.gamma, "seed": arguments.seed, "device": "cpu"}
    model = DDPG(YannPolicy, make(), policy_kwargs=policy, **settings)
    console.print(f"The policy starts as {mpc.online()}.")
    before = evaluate(model, make, TEST_SEEDS)
    log_path = "out/quadrotor.csv"
    guard = ImprovementGuard(make, n_eval_episodes=30, n_new_starts=15, log_path=log_path)
    model.learn(STEPS * arguments.episodes, callback=[NoActionNoise(), guard], progress_bar=True)
    after = evaluate(model, make, TEST_SEEDS)

    print(comparison_table("Cost of 100 unseen starts", before, after))
    taken = sum(each.verdict != "rejected" for each in guard.decisions)
    console.print(f"The guard accepted {taken} of {len(guard.decisions)} candidates.")
    both = {"before (linear MPC)": mpc.online(), "after training": model}
    runs = {name: evaluate(each, make, TEST_SEEDS[:1]) for name, each in both.items()}
    figure = plots.loops_figure(mpc, runs, quantities=[0, 2, 4])
    figure.savefig("out/quadrotor.png")
    console.print("Picture: out/quadrotor.png    The guard's decisions: out/quadrotor.csv")


if __name__ == "__main__":
    main()
