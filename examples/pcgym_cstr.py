"""PC-Gym's reactor: from its equations to an offset-free MPC, and to a policy that starts as it.

pip install 'sb3-yann[pcgym]'; python examples/pcgym_cstr.py
"""

import numpy as np
from rich import print
from stable_baselines3 import DDPG

from sb3_yann import (
    DisturbanceBounds,
    DisturbanceObserver,
    ImprovementGuard,
    LinearMPC,
    NoActionNoise,
)
from sb3_yann.evaluation import evaluate, summary_table
from sb3_yann.wrappers import Deviations, ObserveDisturbance, StageCost
from sb3_yann_envs.pcgym import PCGymEnv

plant = PCGymEnv("cstr")
linear = plant.linear_model(offset_free=True)  # a disturbance of each state, to be estimated
weights = {"Q": np.diag([1e3, 0]), "R": [[2e-3]], "horizon": 5, "gamma": 0.95}
box = {"disturbances": DisturbanceBounds(-1, 1), "tracking": plant.tracking, **plant.bounds}
mpc = LinearMPC(linear, **weights, **box, absolute=True)
moves = np.diag(linear.E)
noise = {"state_noise": moves, "measurement_noise": 0.01 * moves, "disturbance_noise": 10}
observer = DisturbanceObserver(linear, **noise)


def make_env() -> StageCost:
    """Return the plant in deviations, with the estimated disturbance in theta."""
    env = Deviations(PCGymEnv("cstr"), mpc)
    d = mpc.disturbances
    return StageCost(ObserveDisturbance(env, observer, d.d_min, d.d_max), mpc)


def main() -> None:
    """Train under the guard, and compare with the offset-free MPC."""
    policy = {"problem": mpc}
    model = DDPG("YannPolicy", make_env(), policy_kwargs=policy, gamma=0.95, gradient_steps=4)
    before = evaluate(model, make_env, range(2000, 2030))
    callbacks = [NoActionNoise(), ImprovementGuard(make_env)]
    model.learn(3570, callback=callbacks, progress_bar=True)  # 30 episodes
    after = evaluate(model, make_env, range(2000, 2030))
    print(summary_table("Cost of 30 unseen set-point sequences", before, after))


if __name__ == "__main__":
    main()
