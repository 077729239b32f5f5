"""TD3 or DDPG on the clipped pendulum, from its linear MPC onward, without exploration.

python examples/pendulum.py [--algo td3] [--episodes 50] [--seed 0]
"""

from __future__ import annotations

import argparse

import torch
from rich.console import Console
from stable_baselines3 import DDPG, TD3

from sb3_yann import ControlDiagnostics, NoActionNoise, YannPolicy
from sb3_yann.evaluation import evaluate
from sb3_yann.reporting import comparison_table, save_trajectories
from sb3_yann_envs.clipped_pendulum import DT

STEPS = 200  # of one episode
TEST_SEEDS = range(1000, 1010)  # starts that training never sees


def main() -> None:
    """Train, then compare the policy with the MPC that it was at the start."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--algo", choices=["td3", "ddpg"], default="td3")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # the networks are too small to share among cores
    console = Console()

    if arguments.algo == "td3":
        # Noise on the target policy, TD3's default, would spoil the critic's exact start.
        model = TD3(YannPolicy, "ClippedPendulum-v0", target_policy_noise=0.0, seed=arguments.seed)
    else:
        model = DDPG(YannPolicy, "ClippedPendulum-v0", seed=arguments.seed)
    console.print(f"The policy starts as {model.policy.problem.explicit()}.")
    before = evaluate(model, "ClippedPendulum-v0", TEST_SEEDS)
    model.learn(
        STEPS * arguments.episodes,
        callback=[NoActionNoise(), ControlDiagnostics()],
        progress_bar=True,
    )
    after = evaluate(model, "ClippedPendulum-v0", TEST_SEEDS)

    console.print(comparison_table("Cost of ten test episodes, ClippedPendulum-v0", before, after))
    if after.costs.mean() > before.costs.mean():
        console.print("[yellow]Training made the policy worse than its start.[/yellow]")
    picture = save_trajectories(
        "out/pendulum.png",
        {"before (linear MPC)": before, "after training": after},
        states={0: "angle [rad]", 1: "speed [rad/s]"},
        inputs=["torque [N m]"],
        dt=DT,
        time_unit="s",
    )
    console.print(f"Trajectories: {picture}")


if __name__ == "__main__":
    main()
