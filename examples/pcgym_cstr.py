"""PC-Gym's reactor: from its equations to an offset-free MPC, and to a policy that starts as it.

pip install 'sb3-yann[pcgym]'; python examples/pcgym_cstr.py
"""

import numpy as np
from rich import print
from stable_baselines3 import DDPG

from sb3_yann import ImprovementGuard, LinearMPC, NoActionNoise, SimulatedEpisodes, offset_free
from sb3_yann.evaluation import comparison_table, evaluate
from sb3_yann.wrappers import ObserveDisturbance, StageCost
from sb3_yann_envs.pcgym import PCGymEnv

plant = PCGymEnv("cstr")
weights = {"Q": np.diag([1e3, 0]), "R": [[2e-3]], "horizon": 5, "gamma": 0.95}
box = {"tracking": plant.tracking, **plant.bounds}
mpc, observer = offset_free(LinearMPC(plant.linear_model(), **weights, **box))
d = mpc.disturbances  # one of each state, which the observer estimates


def make_env() -> StageCost:
    """Return the plant, with the estimated disturbance in theta."""
    env = ObserveDisturbance(PCGymEnv("cstr"), observer, d.d_min, d.d_max)
    return StageCost(env, mpc)


def main() -> None:
    """Train under the guard, and compare with the offset-free MPC."""
    options = {"policy_kwargs": {"problem": mpc}, "gamma": 0.95, "n_steps": 10, "gradient_steps": 4}
    model = DDPG("YannPolicy", make_env(), device="cpu", **options)
    guard = ImprovementGuard(make_env, n_eval_episodes=20, patience=10, keep_if_worse=True)
    before = evaluate(model, make_env, range(2000, 2030))
    explores = SimulatedEpisodes(make_env)
    model.learn(3570, callback=[NoActionNoise(), explores, guard], progress_bar=True)  # 30 episodes
    after = evaluate(model, make_env, range(2000, 2030))
    print(comparison_table("Cost of 30 unseen set-point sequences", before, after))


if __name__ == "__main__":
    main()
