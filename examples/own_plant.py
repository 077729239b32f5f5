"""From the log of an experiment to a guarded policy, on a plant whose pumps have worn since.

python examples/own_plant.py [--episodes 30] [--seed 0]
"""

import argparse
from functools import partial

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import TimeLimit
from rich.console import Console
from stable_baselines3 import DDPG

from quadruple_tank import DT, FULL, MAX_VOLTAGE, QuadrupleTank, write_log
from sb3_yann import CostAudit, ImprovementGuard, NoActionNoise, YannPolicy
from sb3_yann.control import DisturbanceBounds, LinearModel, LinearMPC, Tracking
from sb3_yann.evaluation import comparison_table, evaluate, plots
from sb3_yann.wrappers import MeasuredDisturbance, SetPoint, StageCost

STEPS, HOLD = 60, 20  # of one episode, and until the set-points change
TEST_SEEDS = range(2000, 2050)  # starts, set-points and disturbances that training never sees


def design() -> LinearMPC:
    """Return the MPC of a model that was identified from a log."""
    write_log("out/log.csv")  # you have yours
    log = np.loadtxt("out/log.csv", delimiter=",", skiprows=1)
    x, u, d = log[:, 1:5], log[:-1, 5:7], log[:-1, 7:]
    plant = LinearModel.from_data(x, u, disturbances=d, dt=DT, u_ss=[3, 3], d_ss=[0])
    plant = plant.named(["h1", "h2", "h3", "h4"], ["v1", "v2"], [*["cm"] * 4, "V", "V"], "s")
    # The discount is the learner's: set-points that nobody knows yet are no matter of the critic.
    weights = {"Q": np.diag([1, 1, 0, 0]), "R": 0.5 * np.eye(2), "horizon": 2, "gamma": 0.9}
    wanted = Tracking([0, 1], plant.x_ss[:2] - 4, plant.x_ss[:2] + 4)
    wishes = {"tracking": wanted, "disturbances": DisturbanceBounds(-1, 1)}
    limits = {"u_min": 0, "u_max": MAX_VOLTAGE, "theta_min": 0, "theta_max": FULL}
    return LinearMPC(plant, **weights, **wishes, **limits)  # as the plant shows them


def make_env(mpc: LinearMPC) -> gymnasium.Env:
    """Return the plant of today, with all that the MPC's theta holds."""
    env = QuadrupleTank(noise=0.03, wear=0.1)
    env = SetPoint(env, mpc.tracking.r_min, mpc.tracking.r_max, hold=HOLD)
    env = MeasuredDisturbance(env, mpc.disturbances.d_min, mpc.disturbances.d_max)
    return TimeLimit(StageCost(env, mpc), STEPS)


def main() -> None:
    """Identify, design, check, train, and compare the policy with the MPC that it was."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # the networks are too small to share among cores
    console, mpc = Console(highlight=False), design()
    console.print(mpc.model.report(), mpc.report(), sep="\n")
    make = partial(make_env, mpc)
    # Five per cent of the pumps' range is more than the wear takes.
    policy = {"problem": mpc, "max_correction": 0.05}
    settings = {"gamma": mpc.gamma, "gradient_steps": 4, "seed": arguments.seed, "device": "cpu"}
    model = DDPG(YannPolicy, make(), policy_kwargs=policy, **settings)
    before = evaluate(model, make, TEST_SEEDS)
    log_path = "out/own_plant.csv"
    guard = ImprovementGuard(make, n_eval_episodes=50, n_new_starts=25, log_path=log_path)
    callbacks = [NoActionNoise(), CostAudit(verbose=1), guard]
    model.learn(STEPS * arguments.episodes, callback=callbacks, progress_bar=True)
    after = evaluate(model, make, TEST_SEEDS)

    print(comparison_table("Cost of 50 unseen set-point sequences", before, after))
    both = {"before (linear MPC)": mpc.explicit(), "after training": model}
    runs = {name: evaluate(policy, make, TEST_SEEDS[:1]) for name, policy in both.items()}
    figure = plots.loops_figure(mpc, runs, quantities=[0, 1, 6, 7, 8])
    figure.savefig("out/own_plant.png")
    console.print("Picture: out/own_plant.png    The guard's decisions: out/own_plant.csv")


if __name__ == "__main__":
    main()
