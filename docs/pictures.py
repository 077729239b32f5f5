"""Draw the pictures of the pages about one trained model, the one that the tutorial saves.

python docs/pictures.py cstr.zip
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.figure import Figure
from PIL import Image
from stable_baselines3 import DDPG

from sb3_yann.evaluation import evaluate, plots
from sb3_yann_envs import problems

if TYPE_CHECKING:
    from sb3_yann.control import LinearMPC

HERE = Path(__file__).parent / "pictures"
STARTS = range(1000, 1004)


def save(figure: Figure, name: str) -> None:
    """Save a figure in few colors, which keeps it small."""
    path = HERE / f"{name}.png"
    figure.savefig(path, dpi=90)
    Image.open(path).convert("RGB").quantize(200).save(path, optimize=True)
    print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


def draw_law() -> None:
    """Draw the pendulum's regions, and its torque over them."""
    mpc = problems.clipped_pendulum()
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    mpc.explicit().plot(axes=left)
    plots.plot_surface(mpc, mpc.explicit(), right)
    save(figure, "law")


def draw_training(mpc: LinearMPC, fresh: DDPG, model: DDPG) -> None:
    """Draw actor and critic along the concentration of B, before training and after."""
    c_b = np.linspace(-0.4, 0.4, 401)
    theta = np.zeros((len(c_b), 4), dtype=np.float32)
    theta[:, 1] = c_b
    figure = Figure(figsize=(8, 3), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(c_b, mpc.law()(theta), color="0.75", linewidth=6, label="MPC")
    for name, each, line in (("before", fresh, "--"), ("after", model, "-")):
        u = each.predict(theta)[0]
        with torch.no_grad():
            action = torch.as_tensor(each.policy.scale_action(u))
            value = each.critic(torch.as_tensor(theta), action)[0].numpy()
        left.plot(c_b, u, line, label=f"policy, {name}")
        right.plot(c_b, -value, line, label=f"critic, {name}")
    left.set(xlabel="C_B (mol/L, from the steady state)", ylabel="U (kJ/(h m² K))")
    right.set(xlabel="C_B (mol/L, from the steady state)", ylabel="cost still to come")
    left.legend()
    right.legend()
    save(figure, "before-after")


def main() -> None:
    """Draw all of them."""
    mpc, model = problems.cstr(), DDPG.load(sys.argv[1], device="cpu")
    fresh = DDPG("YannPolicy", "CSTR-v0", device="cpu")
    runs = {"MPC": evaluate(mpc.explicit(), "CSTR-v0", STARTS)}
    runs["trained"] = evaluate(model, "CSTR-v0", STARTS)
    draw_law()
    draw_training(mpc, fresh, model)
    save(plots.plot_decisions(model.guard_state.decisions).figure, "decisions")
    save(plots.loops_figure(mpc, runs, quantities=["C_B", "T", 4]), "loops")


if __name__ == "__main__":
    main()
