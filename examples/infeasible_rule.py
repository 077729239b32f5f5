"""What the law should do where the MPC has no solution: both rules on both plants, untrained.

python examples/infeasible_rule.py [--episodes 100]
"""

from __future__ import annotations

import argparse
import dataclasses

import numpy as np
from rich.console import Console
from rich.table import Table

from sb3_yann.evaluation import evaluate
from sb3_yann_envs import problems


def main() -> None:
    """Print the cost of the explicit law over seeded episodes under each rule."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=100)
    arguments = parser.parse_args()

    table = Table("plant", "infeasible", "median cost", "mean cost", "largest", "steps outside")
    for env_id, mpc in (
        ("CSTR-v0", problems.cstr()),
        ("ClippedPendulum-v0", problems.clipped_pendulum()),
    ):
        for rule in ("nearest_region", "zero_input"):
            law = dataclasses.replace(mpc.explicit(), infeasible=rule)
            episodes = evaluate(law, env_id, range(2000, 2000 + arguments.episodes))
            inside = law.in_domain(np.concatenate([x[:-1] for x in episodes.observations]))
            numbers = [np.median(episodes.costs), episodes.costs.mean(), episodes.costs.max()]
            share = f"{100 * (1 - inside.mean()):.1f} %"
            table.add_row(env_id, rule, *(f"{number:,.2f}" for number in numbers), share)
    Console().print(table)


if __name__ == "__main__":
    main()
