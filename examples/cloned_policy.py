"""An actor that was cloned from an MPC forgets it when DDPG begins; a YannPolicy does not.

python examples/cloned_policy.py [--episodes 10] [--seed 0]
"""

import argparse

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from stable_baselines3 import DDPG

from sb3_yann import NoActionNoise
from sb3_yann.evaluation import evaluate
from sb3_yann_envs import problems

STEPS = 400  # of one episode
SHOWN, TESTS = range(40), range(1000, 1010)  # starts for the cloning, and for the tests


def tested(model: DDPG) -> str:
    """Return mean cost and violations of the test episodes, in words."""
    played = evaluate(model, "CSTR-v0", TESTS)
    return f"{played.costs.mean():,.2f} ({played.violations.sum()})"


def cloned(seed: int) -> DDPG:
    """Return SB3's own DDPG, its actor fitted to what the MPC does in 40 episodes."""
    model = DDPG("MlpPolicy", "CSTR-v0", seed=seed, device="cpu")
    actor, space = model.policy.actor, model.action_space
    log = evaluate(problems.cstr().explicit(), "CSTR-v0", SHOWN)
    states = np.concatenate([x[:-1] for x in log.observations])
    x = torch.as_tensor(states, dtype=torch.float32)
    u = 2 * (np.concatenate(log.actions) - space.low) / (space.high - space.low) - 1
    optimizer = torch.optim.Adam(actor.parameters(), 1e-3)
    for rows in np.random.default_rng(seed).integers(len(x), size=(2000, 256)):
        loss = torch.mean((actor(x[rows]) - torch.as_tensor(u[rows], dtype=torch.float32)) ** 2)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    model.policy.actor_target.load_state_dict(actor.state_dict())
    return model


def main() -> None:
    """Train both for as long, without noise, and show what became of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # the networks are too small to share among cores
    learners = {
        "cloned MPC": cloned(arguments.seed),
        "YannPolicy": DDPG("YannPolicy", "CSTR-v0", seed=arguments.seed, device="cpu"),
    }
    table = Table("episodes", *learners, title="Mean cost of ten test episodes (violations)")
    done = 0
    for episodes in [n for n in (0, 1, 2, 3, 5) if n < arguments.episodes] + [arguments.episodes]:
        for model in learners.values():
            steps, go_on = STEPS * (episodes - done), {"reset_num_timesteps": False}
            model.learn(steps, callback=NoActionNoise(), **go_on)
        done = episodes
        table.add_row(str(episodes), *map(tested, learners.values()))
    Console().print(table)


if __name__ == "__main__":
    main()
