"""A worn quadruple tank, recovered from the log of its MPC: `python -m experiments.tank`.

The plant is that of examples/quadruple_tank.py. Its MPC knows it as it was when it was new. Ten
episodes of the MPC are the log: each has its own set-points, and nothing excites the plant. Prints
the table of docs/twin.md.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
import torch as th
from scipy.optimize import fsolve
from stable_baselines3 import DDPG

from examples.quadruple_tank import (
    AREA,
    DT,
    FULL,
    GRAVITY,
    LEVELS_SS,
    MAX_VOLTAGE,
    OUTLET,
    PUMP_GAIN,
    SPLIT,
    SUBSTEPS,
    VOLTAGES_SS,
)
from sb3_yann import LinearModel, LinearMPC, PlantTwin, Tracking, improve
from sb3_yann._validation import Array
from sb3_yann.twin.gradient import actor

STEPS, EPISODES = 60, 10
NOISE = 0.02
"""Standard deviation of what waves add to each level in a step, in cm."""
REACH = np.array([2.0, 2.0, 0.5, 0.5])
"""How far from the operating point levels begin, in cm, at most; set-points as lower ones."""
SEEDS, UNWORN = range(20, 30), range(20, 40)
TESTED, TEST_SEED = 200, 9
"""Episodes of the plant, in no log, that every policy is measured on."""

Controller = Callable[[Array, Array], Array]
"""From levels (k, 4) and wanted lower levels (k, 2) to voltages (k, 2)."""


class Tank(NamedTuple):
    """The plant's parameters, as factors of those that it had when it was new."""

    pumps: tuple[float, float] = (1.0, 1.0)
    outlets: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    split: tuple[float, float] = (1.0, 1.0)

    def slope(self, h: Array, v: Array) -> Array:
        """Return how fast levels h (k, 4) rise at voltages v (k, 2), in cm/s."""
        out = np.array(OUTLET) * self.outlets * np.sqrt(2 * GRAVITY * np.maximum(h, 0.0))
        flow, low = v * PUMP_GAIN * self.pumps, np.array(SPLIT) * self.split
        into = np.concatenate([low * flow, ((1 - low) * flow)[:, ::-1]], axis=1)
        into[:, :2] += out[:, 2:]
        return np.asarray((into - out) / AREA)

    def advance(self, h: Array, v: Array) -> Array:
        """Return the levels (k, 4) one sample later, as `quadruple_tank.advance` has it."""
        step = DT / SUBSTEPS
        for _ in range(SUBSTEPS):
            k1 = self.slope(h, v)
            k2 = self.slope(h + step / 2 * k1, v)
            k3 = self.slope(h + step / 2 * k2, v)
            k4 = self.slope(h + step * k3, v)
            h = np.maximum(h + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4), 0.0)
        return np.minimum(h, FULL)

    def model(self) -> LinearModel:
        """Return the model about the published lower levels, at rest."""
        lower = LEVELS_SS[:2]

        def rises(rest: Array) -> Array:
            return self.slope(np.array([[*lower, *rest[:2]]]), rest[None, 2:])[0]

        rest = fsolve(rises, [*LEVELS_SS[2:], *VOLTAGES_SS], xtol=1e-12)
        x, u = np.array([*lower, *rest[:2]]), rest[2:]
        return LinearModel.from_dynamics(lambda h, v: self.slope(h[None], v[None])[0], x, u, DT)


NEW = Tank()
WEAR = {
    "both pumps lost 15 %": Tank(pumps=(0.85, 0.85)),
    "pump 1 lost 20 %": Tank(pumps=(0.8, 1.0)),
    "lower outlets narrowed by 10 %": Tank(outlets=(0.9, 0.9, 1.0, 1.0)),
    "pumps, outlets and valves": Tank((0.9, 0.85), (0.95, 1.0, 1.1, 0.9), (0.97, 1.03)),
}


@cache
def mpc_of(plant: Tank) -> LinearMPC:
    """Return the MPC with a model of a plant: the lower levels follow set-points."""
    model = plant.model()
    return LinearMPC(
        model, Q=np.diag([1.0, 1.0, 0.0, 0.0]), R=0.1 * np.eye(2), horizon=2,
        u_min=0 - model.u_ss, u_max=MAX_VOLTAGE - model.u_ss,
        theta_min=0 - model.x_ss, theta_max=FULL - model.x_ss, tracking=Tracking([0, 1], -4, 4),
    )  # fmt: skip


def controller(problem: LinearMPC, act: Callable[[Array], Array] | None = None) -> Controller:
    """Return an MPC, or a policy of its theta (k, 6), in the plant's units."""
    law, x, u = problem.explicit() if act is None else act, problem.model.x_ss, problem.model.u_ss
    return lambda h, wanted: u + law(np.concatenate([h - x, wanted - x[:2]], axis=1))


def play(plant: Tank, act: Controller, count: int, seed: int) -> tuple[Array, Array]:
    """Return thetas (k, T + 1, 6) and inputs (k, T, 2) of episodes, as the new plant's MPC sees it.

    The draws are the same for every plant and controller.
    """
    rng, new = np.random.default_rng(seed), mpc_of(NEW).model
    h = new.x_ss + rng.uniform(-REACH, REACH, (count, 4))
    wanted = new.x_ss[:2] + rng.uniform(-REACH[:2], REACH[:2], (count, 2))
    levels, inputs = [h], []
    for _ in range(STEPS):
        inputs.append(np.clip(act(h, wanted), 0, MAX_VOLTAGE))
        waves = NOISE * rng.standard_normal(h.shape)
        h = np.clip(plant.advance(h, inputs[-1]) + waves, 0, FULL)
        levels.append(h)
    x = np.moveaxis(levels, 0, 1) - new.x_ss
    r = np.broadcast_to((wanted - new.x_ss[:2])[:, None], (count, STEPS + 1, 2))
    return np.concatenate([x, r], axis=2), np.moveaxis(inputs, 0, 1) - new.u_ss


def costs(plant: Tank, act: Controller) -> Array:
    """Return the costs of the tested episodes."""
    thetas, inputs = play(plant, act, TESTED, TEST_SEED)
    return np.asarray(mpc_of(NEW).stage_cost(thetas[:, :-1], inputs).sum(axis=1))


class Outcome(NamedTuple):
    """What came of one log; shares are those of what the wear costs."""

    recovered: float
    by_reidentification: float
    worst: float
    """The largest increase of an episode's cost, relative to the mean."""
    accepted: bool
    in_twin: float
    on_plant: float
    """Changes of the mean cost, relative to it."""


def run(plant: Tank, seed: int) -> Outcome:
    """Fit a twin to a log, improve the policy in it, and measure it on the plant."""
    th.set_num_threads(1)
    problem = mpc_of(NEW)
    mpc, ideal = costs(plant, controller(problem)), costs(plant, controller(mpc_of(plant)))
    logged = play(plant, controller(problem), EPISODES, 1_000 + seed)
    twin = PlantTwin.fit(problem, [*zip(*logged, strict=True)], seed=seed)
    model = DDPG("YannPolicy", twin.env(), policy_kwargs={"problem": problem}, device="cpu")
    found, layer = improve(model, twin, seed=seed), model.policy.actor.mu
    ours = costs(plant, controller(problem, actor(layer, problem)))
    again = costs(plant, controller(twin.reidentified()))
    wear = mpc.mean() - ideal.mean()
    shares = [(mpc.mean() - each.mean()) / wear if plant != NEW else 0.0 for each in (ours, again)]
    worst, change = (ours - mpc).max() / mpc.mean(), ours.mean() / mpc.mean() - 1
    return Outcome(*shares, worst, found.accepted, found.change, change)


def row(name: str, plant: Tank) -> str:
    """Return the row of a kind of wear: all changes in percent."""
    mpc, ideal = costs(plant, controller(mpc_of(NEW))), costs(plant, controller(mpc_of(plant)))
    outcomes = [run(plant, seed) for seed in SEEDS]
    ours, again = (100 * np.array([each[k] for each in outcomes]) for k in (0, 1))
    spread = (
        f"{np.median(each):.0f} ({each.min():.0f} to {each.max():.0f})" for each in (ours, again)
    )
    enough = f"{np.sum(ours >= 80)} of {len(ours)}"
    worst = f"{100 * max(each.worst for each in outcomes):+.0f}"
    parts = name, f"{mpc.mean():.2f}", f"{ideal.mean():.2f}", *spread, enough, worst
    return f"| {' | '.join(parts)} |"


def main() -> None:
    """Print the table, and what happens without wear."""
    print("| wear | MPC | MPC that knows it | `improve` recovers, % | re-identified MPC, % "
          "| 80 % and more | worst episode, % |")  # fmt: skip
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, plant in WEAR.items():
        print(row(name, plant), flush=True)
    found = [run(NEW, seed) for seed in UNWORN]
    twin, plant = (100 * np.array([each[k] for each in found]) for k in (-2, -1))
    accepted = sum(each.accepted for each in found)
    print(f"\nWithout wear {accepted} of {len(found)} runs accept a policy. Mean cost in the twin: "
          f"{twin.min():+.3f} to {twin.max():+.3f} %, on the plant: {plant.min():+.3f} to "
          f"{plant.max():+.3f} %.")  # fmt: skip
    for least in (0.1, 0.2, 0.5):
        print(f"{np.sum(twin <= -least)} of them gain {least} % and more in the twin.")


if __name__ == "__main__":
    main()
