"""From a plant's log to a better controller: CSV in, report and model out, no simulator.

The reactor stands for the plant. It gives the log of its MPC at first, and shows at the end what
the new controller is worth; in between nothing acts on it.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from stable_baselines3 import DDPG

from sb3_yann import PlantTwin, improve
from sb3_yann.evaluation import evaluate
from sb3_yann_envs import problems

OUT = Path("out")
LOG = OUT / "log.csv"
EPISODES, TESTS = range(5), range(1000, 1030)


def write_log() -> None:
    """Write five episodes of the MPC, as a historian has them: one row for each sample."""
    played = evaluate(problems.cstr().explicit(), "CSTR-v0", EPISODES)
    rows = []
    for number, (x, u) in enumerate(zip(played.observations, played.actions, strict=True)):
        inputs = np.vstack([u, np.full((1, u.shape[1]), np.nan)])  # none after the last sample
        rows.append(np.column_stack([np.full(len(x), number), x, inputs]))
    header = "episode,C_A,C_B,C_S,T,U"
    np.savetxt(LOG, np.concatenate(rows), delimiter=",", header=header, comments="")


def read_log() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the episodes of the file: states (T + 1, 4) and inputs (T, 1), as deviations."""
    table = np.genfromtxt(LOG, delimiter=",", skip_header=1)
    episodes = [table[table[:, 0] == number] for number in np.unique(table[:, 0])]
    return [(rows[:, 1:5], rows[:-1, 5:]) for rows in episodes]


def save_picture(changes: np.ndarray) -> Path:
    """Save what each test episode costs above the MPC, in % of the MPC's mean."""
    figure = Figure(figsize=(8, 3), layout="constrained")
    axes = figure.subplots()
    axes.bar(TESTS, np.sort(changes), label="improved policy")
    axes.axhline(0, color="black", linewidth=3, label="MPC")
    axes.axhline(changes.mean(), color="C1", linestyle="--", label="mean")
    axes.set(xticks=[], xlabel="test episodes, sorted", ylabel="change of the cost, %")
    axes.legend()
    figure.savefig(path := OUT / "from_a_log.png", dpi=120)
    return path


def main() -> None:
    """Fit the twin, improve the policy in it, and compare it with the MPC on the plant."""
    OUT.mkdir(exist_ok=True)
    write_log()
    problem = problems.cstr()
    twin = PlantTwin.fit(problem, read_log())
    (OUT / "twin.txt").write_text(twin.report() + "\n", encoding="utf-8")
    print(twin.report())
    if not twin.trusted:
        return
    model = DDPG("YannPolicy", twin.env(), policy_kwargs={"problem": problem}, device="cpu")
    found = improve(model, twin)
    model.save(OUT / "from_a_log")
    print(f"\n{found}")
    ours = evaluate(model, "CSTR-v0", TESTS)
    mpc = evaluate(problem.explicit(), "CSTR-v0", TESTS)
    changes = 100 * (ours.costs - mpc.costs) / mpc.costs.mean()
    print(f"On the plant, {len(TESTS)} new episodes:")
    print(f"  mean cost     {mpc.costs.mean():.2f} (MPC) -> {ours.costs.mean():.2f}")
    print(
        f"  worst episode {changes.max():+.2f} % of the mean; violations: {ours.violations.sum()}"
    )
    print(f"Saved: {LOG}, {OUT / 'twin.txt'}, {OUT / 'from_a_log.zip'}, {save_picture(changes)}")


if __name__ == "__main__":
    main()
