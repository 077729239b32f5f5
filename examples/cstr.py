"""DDPG on the safety-critical reactor, from its linear MPC onward, never worse than it.

python examples/cstr.py [--episodes 50] [--seed 0]
"""

from __future__ import annotations

import argparse

import torch
from rich.console import Console
from stable_baselines3 import DDPG

from sb3_yann import ControlDiagnostics, ImprovementGuard, NoActionNoise, YannPolicy
from sb3_yann.evaluation import comparison_table, evaluate, plots
from sb3_yann_envs.cstr import TEMPERATURE_LIMIT

STEPS = 400  # of one episode
TEST_SEEDS = range(1000, 1010)  # starts that training never sees


def main() -> None:
    """Train, then compare the policy with the MPC that it was at the start."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # the networks are too small to share among cores
    console = Console()

    settings = {"seed": arguments.seed, "device": "cpu", "tensorboard_log": "out/tensorboard"}
    model = DDPG(YannPolicy, "CSTR-v0", **settings)
    console.print(f"The policy starts as {model.policy.problem.explicit()}.")
    before = evaluate(model, "CSTR-v0", TEST_SEEDS)

    diagnostics = ControlDiagnostics()
    guard = ImprovementGuard("CSTR-v0", log_path="out/guard.csv")
    console.print(f"Training for {arguments.episodes} episodes without action noise ...")
    callbacks = [NoActionNoise(), guard, diagnostics]
    model.learn(STEPS * arguments.episodes, callback=callbacks, progress_bar=True)
    after = evaluate(model, "CSTR-v0", TEST_SEEDS)

    print(comparison_table("Cost of ten test episodes, CSTR-v0", before, after))
    console.print(f"Violations of {TEMPERATURE_LIMIT:g} K in training: {diagnostics.violations}")
    taken = sum(each.verdict != "rejected" for each in guard.decisions)
    console.print(
        f"The guard accepted {taken} of {len(guard.decisions)} candidates, whole or in part; "
        "each decision is in out/guard.csv."
    )
    runs = {"before (linear MPC)": before, "after training": after}
    figure = plots.loops_figure(model.policy.problem, runs, quantities=["T", "C_A", "U"])
    figure.savefig("out/cstr.png")
    console.print("Trajectories: out/cstr.png    Curves: tensorboard --logdir out/tensorboard")


if __name__ == "__main__":
    main()
