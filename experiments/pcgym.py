"""Plants of PC-Gym: `python -m experiments.pcgym`, some hours of one core; needs the extra `pcgym`.

The linear MPCs, an NMPC, YANN-RL from the offset-free MPC, with a simulator and from a log alone,
and four learners of Stable-Baselines3. Writes the table into docs/environments.md; `make paper`
does the runs too, where PC-Gym is installed. Nothing was tuned on these seeds and episodes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import RescaleAction, RescaleObservation
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback

from experiments.markdown import number, quote, spread, table
from experiments.measures import MPC, OURS, REIDENTIFIED
from experiments.pcgym_nmpc import NonlinearMPC
from experiments.runner import RESULTS, Outcome, Run, load_all, run_all
from sb3_yann import (
    DisturbanceBounds,
    DisturbanceObserver,
    ImprovementGuard,
    LinearMPC,
    NoActionNoise,
    PlantTwin,
    SimulatedEpisodes,
    YannPolicy,
    improve,
)
from sb3_yann.evaluation import Trajectories, evaluate
from sb3_yann.wrappers import ObserveDisturbance, StageCost
from sb3_yann_envs.pcgym import PCGymEnv

HORIZONS = {"cstr": 5, "four_tank": 3, "multistage_extraction": 1}
"""Of the MPCs, chosen on episodes 100 to 109."""
PLANTS = {f"PC-Gym, {name}": name for name in HORIZONS}
OFFSET_FREE = "offset-free MPC"
NMPC = "NMPC"
IN_SIMULATOR = f"{OURS}, `improve` in a simulator"
FROM_A_LOG = f"{OURS}, from a log"
FIXED = MPC, OFFSET_FREE, REIDENTIFIED, NMPC
RIVALS: dict[str, type[Any]] = {"DDPG": DDPG, "TD3": TD3, "SAC": SAC, "PPO": PPO}
CONTROLLERS = (*FIXED, OURS, IN_SIMULATOR, FROM_A_LOG, *RIVALS)
TESTS = range(3000, 3030)
LOG = 10  # episodes
EPISODES = 50
STEPS = 50_000
LONG = f", {STEPS:,} steps"
SEEDS = {
    FROM_A_LOG: range(40, 50),
    OURS: range(40, 50),
    IN_SIMULATOR: range(40, 50),
    **dict.fromkeys(("DDPG", "TD3", "SAC"), range(40, 41)),
    **{f"{name}{LONG}": range(40, 41) for name in RIVALS},
}
HEADER = (
    "plant",
    "controller",
    "training steps",
    "cost against offset-free, %",
    "worst episode, %",
    "ms a step",
)
BEGIN = "<!-- plants: begin -->\n"
END = "<!-- plants: end -->"


class Case:
    """A plant with its linear MPC, with an observer or without."""

    def __init__(self, name: str, offset_free: bool = False) -> None:
        self.name = name
        self.plant = plant = PCGymEnv(name)
        model = plant.linear_model(offset_free=offset_free)
        error = 1e3 * np.isin(np.arange(len(plant.x0)), plant.outputs)
        self.observer: DisturbanceObserver | None = None
        more: dict[str, Any] = {}
        if offset_free:
            moves = np.diag(model.E)
            more = {"disturbances": DisturbanceBounds(-1, 1)}
            noise = {"state_noise": moves, "measurement_noise": 0.01 * moves}
            self.observer = DisturbanceObserver(model, **noise, disturbance_noise=10)
        self.mpc = LinearMPC(
            model, Q=np.diag(error), R=np.diag(0.1 / (plant.u_max - plant.u_min) ** 2),
            horizon=HORIZONS[name], gamma=0.95, tracking=plant.tracking,
            **more, **plant.bounds,
        )  # fmt: skip

    def env(self) -> gym.Env[Any, Any]:
        """Return the plant, with PC-Gym's reward."""
        env: gym.Env[Any, Any] = PCGymEnv(self.name)
        if self.observer is None:
            return env
        bounds = self.mpc.disturbances
        return ObserveDisturbance(env, self.observer, bounds.d_min, bounds.d_max)

    def taught(self) -> gym.Env[Any, Any]:
        """Return the same with the MPC's stage cost."""
        return StageCost(self.env(), self.mpc)


def scaled(name: str) -> gym.Env[Any, Any]:
    """Return a plant with observations and actions in [-1, 1]."""
    one: Any = np.float32(1)
    return RescaleObservation(RescaleAction(PCGymEnv(name), -one, one), -one, one)


class Rival:
    """What a model of `scaled` does to theta."""

    def __init__(self, model: Any, case: Case) -> None:
        self.model = model
        self.plant = case.plant

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        """Return inputs (batch, m)."""
        box = self.plant.observation_space
        plant = self.plant
        shown = 2 * (theta - box.low) / (box.high - box.low) - 1
        action = self.model.predict(shown.astype(np.float32), deterministic=True)[0]
        return np.asarray(
            plant.u_min + (np.clip(action, -1, 1) + 1) / 2 * (plant.u_max - plant.u_min)
        )


class Batched:
    """A controller that `evaluate` asks for all episodes at a time; a function, row by row."""

    def __init__(self, act: Callable[[Any], Any]) -> None:
        self.act = act

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, None]:
        """Act."""
        return self.act(observation), None


class Timed:
    """A controller, and how long it takes, in s."""

    def __init__(self, act: Callable[[Any], Any]) -> None:
        self.act: Callable[[Any], Any] = act
        self.times: list[float] = []

    def __call__(self, theta: Any) -> Any:
        """Act."""
        began = time.perf_counter()
        found = self.act(theta)
        self.times.append(time.perf_counter() - began)
        return found


def runs() -> list[Run]:
    """Return all runs; those of one seed come before those of the next."""
    found = [Run(plant, name, 0, 0) for plant in PLANTS for name in FIXED]
    longest = max(map(len, SEEDS.values()))
    for i in range(longest):
        for name, seeds in SEEDS.items():
            episodes = {FROM_A_LOG: LOG, IN_SIMULATOR: 0}.get(name, EPISODES)
            found += [Run(plant, name, seeds[i], episodes) for plant in PLANTS if i < len(seeds)]
    return found


def execute(run: Run) -> Outcome:
    """Return the outcome of a run: PC-Gym's costs as those of its tests."""
    began = time.perf_counter()
    name = PLANTS[run.plant]
    case = Case(name, offset_free=run.learner in (OFFSET_FREE, OURS, IN_SIMULATOR, FROM_A_LOG))
    tested: dict[int, tuple[Trajectories, float]] = {}

    def test(steps: int, act: Callable[[Any], Any]) -> None:
        played = evaluate(Batched(act), case.env, TESTS)
        one = Timed(act)
        evaluate(one, case.env(), TESTS[:1])  # a row at a time, as a plant asks
        tested[steps] = played, 1e3 * float(np.median(one.times))

    steps = len(case.plant.schedule) - 1
    if run.learner in FIXED:
        problem = reidentified(case) if run.learner == REIDENTIFIED else case.mpc
        test(0, NonlinearMPC(case) if run.learner == NMPC else problem.explicit())
    elif run.learner == OURS:
        model = policy_of(case, run.seed, tau=0.005, n_steps=10, gradient_steps=4)
        guard = ImprovementGuard(case.taught, patience=10, keep_if_worse=True)
        explores = SimulatedEpisodes(case.taught)
        model.learn(steps * EPISODES, callback=[NoActionNoise(), explores, guard])
        test(steps * EPISODES, partial(acted, model))
    elif run.learner == IN_SIMULATOR:
        model = policy_of(case, run.seed)
        improve(model, case.taught, seed=run.seed)
        test(0, partial(acted, model))
    elif run.learner == FROM_A_LOG:
        model = policy_of(case, run.seed)
        twin = twin_of(case, run.seed)
        if twin.trusted:
            improve(model, twin, seed=run.seed)
        test(steps * LOG, partial(acted, model))
    else:
        rival = RIVALS[run.learner.removesuffix(LONG)]
        model = rival("MlpPolicy", scaled(name), gamma=0.95, seed=run.seed, device="cpu")
        first = steps * EPISODES
        last = STEPS if run.learner.endswith(LONG) else first
        during = TestAt(first, lambda: test(first, Rival(model, case)))
        model.learn(last, callback=during)
        if last > first:
            test(last, Rival(model, case))
    return outcome(case, tested, time.perf_counter() - began)


def outcome(
    case: Case, tested: Mapping[int, tuple[Trajectories, float]], seconds: float
) -> Outcome:
    """Return tests after so many steps as an outcome: their costs by both metrics."""
    plain = Case(case.name).mpc
    size = case.plant.observation_space.shape[0]
    stage = [
        [
            float(plain.stage_cost(seen[:-1, :size], taken).sum())
            for seen, taken in zip(each.observations, each.actions, strict=True)
        ]
        for each, _ in tested.values()
    ]
    none = np.zeros(0)
    return Outcome(
        np.array([*tested]),
        np.array([each.costs for each, _ in tested.values()]),
        np.array([each.violations for each, _ in tested.values()]),
        none, none, none,
        {"stage_costs": np.array(stage), "ms": np.array([ms for _, ms in tested.values()])},
        seconds,
    )  # fmt: skip


class TestAt(BaseCallback):
    """Tests once, after so many steps."""

    def __init__(self, steps: int, test: Callable[[], None]) -> None:
        super().__init__()
        self.steps = steps
        self.test = test

    def _on_step(self) -> bool:
        if self.num_timesteps == self.steps:
            self.test()
        return True


def policy_of(case: Case, seed: int, **options: Any) -> DDPG:
    """Return a model that starts as the MPC; nothing is set for the plant."""
    return DDPG(
        YannPolicy, case.taught(), gamma=0.95, seed=seed, device="cpu",
        policy_kwargs={"problem": case.mpc}, **{"tau": 0.02, **options},
    )  # fmt: skip


def acted(model: DDPG, theta: np.ndarray) -> np.ndarray:
    """Return what a model does, without noise."""
    return np.asarray(model.predict(theta, deterministic=True)[0])


def log_of(case: Case, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return episodes of the MPC."""
    played = evaluate(case.mpc.explicit(), case.env, range(1000 * seed, 1000 * seed + LOG))
    return [*zip(played.observations, played.actions, strict=True)]


def twin_of(case: Case, seed: int) -> PlantTwin:
    """Return a twin of a log, with the observer."""
    return PlantTwin.fit(case.mpc, log_of(case, seed), observer=case.observer, seed=seed)


def reidentified(case: Case) -> LinearMPC:
    """Return the MPC whose model is identified again, from a log of the MPC."""
    return PlantTwin.fit(case.mpc, log_of(case, 40)).reidentified()


def rows(outcomes: Mapping[Run, Outcome]) -> list[tuple[str, ...]]:
    """Return the rows of the table: medians and ranges over the seeds."""
    found = []
    for plant in PLANTS:
        base = outcomes.get(Run(plant, OFFSET_FREE, 0, 0))
        if base is None:
            continue
        for name in CONTROLLERS:
            at: dict[int, dict[int, tuple[Outcome, int]]] = {}
            for run, each in outcomes.items():
                if run.plant == plant and run.learner.removesuffix(LONG) == name:
                    for k, steps in enumerate(each.checkpoints):
                        at.setdefault(int(steps), {})[run.seed] = each, k
            if at:
                longest = max(at)
                found.append(_row(plant, name, longest, [*at[longest].values()], base))
    return found


def _row(
    plant: str, name: str, steps: int, tests: Sequence[tuple[Outcome, int]], base: Outcome
) -> tuple[str, ...]:
    """Return the row of a controller after so many steps."""
    ours = base.test_costs[0]
    costs = [each.test_costs[k] for each, k in tests]
    change = np.array([100 * (each.mean() / ours.mean() - 1) for each in costs])
    worst = max(100 * ((each - ours) / ours.mean()).max() for each in costs)
    shown = spread(change) if len(change) > 1 else f"{change[0]:+.2f}"
    ms = np.median([each.extra["ms"][k] for each, k in tests])
    return plant, name, f"{steps:,}" if steps else "", shown, f"{worst:+.2f}", number(ms, 2)


def by_controller(found: Sequence[tuple[str, ...]]) -> str:
    """Return the rows as a table of a line for each controller: its cost, and its worst episode."""
    cells = {(plant, name): f"{cost}; {worst}" for plant, name, _, cost, worst, _ in found}
    names = [name for name in CONTROLLERS if any((plant, name) in cells for plant in PLANTS)]
    lines = [[name, *(cells.get((plant, name), "") for plant in PLANTS)] for name in names]
    return table(("controller", *PLANTS.values()), lines)


def write_report(outcomes: Mapping[Run, Outcome], folder: Path) -> list[Path]:
    """Quote the table in ``environments.md`` if it is there; return the paths that were written."""
    found = rows(outcomes)
    page = folder / "environments.md"
    return [page] if found and quote(by_controller(found), page, BEGIN, END) else []


def main(arguments: Sequence[str] | None = None) -> None:
    """Do the runs that are missing, print the table and quote it."""
    parser = argparse.ArgumentParser(prog="python -m experiments.pcgym", description=__doc__)
    parser.add_argument("--jobs", type=int, default=-1, help="processes (all cores)")
    parser.add_argument("--results", type=Path, default=RESULTS, help="file of the runs")
    parser.add_argument("--report-only", action="store_true", help="of the runs that are done")
    parser.add_argument("--report", type=Path, default=Path("docs"), help="folder of the page")
    options = parser.parse_args(arguments)
    if options.report_only:
        found = load_all(runs(), options.results)
    else:
        found = run_all(runs(), execute, options.results, jobs=options.jobs)
    print(table(HEADER, rows(found), texts=2))
    for path in write_report(found, options.report):
        print(f"Written: {path}")


if __name__ == "__main__":
    main()
