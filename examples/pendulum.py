"""DDPG or TD3 on the clipped pendulum, from its linear MPC onward, never worse than it.

python examples/pendulum.py [--algo ddpg] [--episodes 50] [--seed 0]
"""

from __future__ import annotations

import argparse

import torch
from rich.console import Console
from stable_baselines3 import DDPG, TD3

from sb3_yann import ControlDiagnostics, ImprovementGuard, NoActionNoise, YannPolicy
from sb3_yann.evaluation import comparison_table, evaluate, plots

STEPS = 200  # of one episode
TEST_SEEDS = range(1000, 1010)  # starts that training never sees


def main() -> None:
    """Train, then compare the policy with the MPC that it was at the start."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--algo", choices=["ddpg", "td3"], default="ddpg")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # the networks are too small to share among cores
    console = Console()

    # Few starts have to swing, so few episodes tell how: each is used twice, and the actor waits.
    settings = {"gradient_steps": 2, "policy_kwargs": {"critic_warmup": 4000}, "device": "cpu"}
    if arguments.algo == "td3":
        # Noise on the target policy, TD3's default, would spoil the critic's exact start.
        settings["target_policy_noise"] = 0.0
    algorithm = {"ddpg": DDPG, "td3": TD3}[arguments.algo]
    model = algorithm(YannPolicy, "ClippedPendulum-v0", seed=arguments.seed, **settings)
    console.print(f"The policy starts as {model.policy.problem.explicit()}.")
    before = evaluate(model, "ClippedPendulum-v0", TEST_SEEDS)
    # The way from hanging to swinging leads through worse policies: the guard waits for them.
    guard = ImprovementGuard(
        "ClippedPendulum-v0", patience=10, keep_if_worse=True, log_path="out/guard.csv"
    )
    callbacks = [NoActionNoise(), guard, ControlDiagnostics()]
    model.learn(STEPS * arguments.episodes, callback=callbacks, progress_bar=True)
    after = evaluate(model, "ClippedPendulum-v0", TEST_SEEDS)

    print(comparison_table("Cost of ten test episodes, ClippedPendulum-v0", before, after))
    runs = {"before (linear MPC)": before, "after training": after}
    plots.loops_figure(model.policy.problem, runs).savefig("out/pendulum.png")
    console.print("Trajectories: out/pendulum.png")


if __name__ == "__main__":
    main()
