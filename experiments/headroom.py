"""What there is to gain on several plants: `python -m experiments.headroom`, a quarter of an hour.

Prints the tables of docs/headroom.md and puts them there: that of PC-Gym's plants where it is
installed. With names of plants, prints their rows.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
from gymnasium.wrappers import TimeLimit

from examples.quadruple_tank import QuadrupleTank
from experiments import pcgym, tank
from experiments.catalog import PLANTS, TEST_SEEDS
from experiments.markdown import number, table
from experiments.summary import quote
from sb3_yann import Headroom, LinearMPC, PlantTwin, headroom
from sb3_yann.evaluation import evaluate
from sb3_yann.evaluation.episodes import Source
from sb3_yann.wrappers import Deviations, SetPoint

STARTS = 20
HOLD = 20
"""Steps after which the tank has another set-point."""
HEADER = ("plant", "MPC", "total", "offset", "model error", "nonlinearity", "verdict", "seconds")
REACTOR = "CSTR"
# The examples import each other by name.
EXAMPLES = str(Path(__file__).parents[1] / "examples")


class Case(NamedTuple):
    """An MPC, its plant or twin, and how many starts from which seed on."""

    mpc: LinearMPC
    plant: Source | PlantTwin
    starts: int = STARTS
    seed: int = TEST_SEEDS[0]


def of_catalog(name: str, starts: int = STARTS) -> Case:
    """Return a plant of the results."""
    return Case(PLANTS[name].problem(), PLANTS[name].env_id, starts)


def twin_of_a_log(first: int) -> Case:
    """Return a twin of five episodes of the reactor's MPC."""
    mpc = PLANTS[REACTOR].problem()
    runs = evaluate(mpc.explicit(), PLANTS[REACTOR].env_id, range(first, first + 5))
    twin = PlantTwin.fit(mpc, [*zip(runs.observations, runs.actions, strict=True)])
    return Case(mpc, twin, seed=0)


def worn_tank() -> Case:
    """Return the tank whose MPC knows it as it was when it was new; its pumps lost a tenth."""
    mpc = tank.mpc_of(tank.NEW)

    def make() -> gym.Env:
        env = Deviations(QuadrupleTank(wear=0.1), mpc.model)
        return TimeLimit(SetPoint(env, -tank.REACH[:2], tank.REACH[:2], hold=HOLD), tank.STEPS)

    return Case(mpc, make)


def own_plant() -> Case:
    """Return the tank of an example, with waves and a disturbance that is measured."""
    import own_plant

    mpc = own_plant.design()
    return Case(mpc, partial(own_plant.make_env, mpc))


def quadrotor() -> Case:
    """Return the quadrotor of an example."""
    import quadrotor

    mpc = quadrotor.hover()
    return Case(mpc, partial(quadrotor.make_env, mpc), starts=5, seed=0)


def of_pcgym(name: str, offset_free: bool = False) -> Case:
    """Return a plant of PC-Gym with its linear MPC, with an observer or without."""
    case = pcgym.Case(name, offset_free)
    return Case(case.mpc, case.env)


CASES: dict[str, Callable[[], Case]] = {
    "reactor": partial(of_catalog, REACTOR),
    "reactor, a hundred starts": partial(of_catalog, REACTOR, len(TEST_SEEDS)),
    "reactor, true model": partial(of_catalog, "CSTR, true model"),
    "twin of a log of the reactor": partial(twin_of_a_log, 0),
    "twin of another log": partial(twin_of_a_log, 1000),
    "pendulum, Q = diag(1, 0.1)": partial(of_catalog, "pendulum, Q = diag(1, 0.1)"),
    "pendulum, Q = I": partial(of_catalog, "pendulum, Q = I"),
    "worn tank, set-points": worn_tank,
    "`examples/own_plant.py`": own_plant,
    "`examples/quadrotor.py`": quadrotor,
}
PCGYM_CASES: dict[str, Callable[[], Case]] = {
    f"PC-Gym, `{name}`{', offset-free' * free}": partial(of_pcgym, name, free)
    for free in (False, True)
    for name in pcgym.HORIZONS
}


def row(found: Headroom, measured: bool) -> list[str]:
    """Return the figures of a plant: no offset where its disturbances are measured."""
    offset = "" if measured else number(-100 * found.offset)
    total, error, rest = (
        number(-100 * part) for part in (found.total, found.model_error, found.nonlinearity)
    )
    return [number(found.mpc_costs.mean()), total, offset, error, rest, found.verdict]


def measure(cases: Mapping[str, Callable[[], Case]], names: Iterable[str]) -> str:
    """Return the table of some cases."""
    rows = []
    for name in names:
        case, began = cases[name](), time.perf_counter()
        found = headroom(case.mpc, case.plant, n_starts=case.starts, seed=case.seed)
        seconds = f"{time.perf_counter() - began:.0f}"
        rows.append([name, *row(found, case.mpc.layout.n_disturbances > 0), seconds])
        print(f"{name}\n{found}\n", flush=True)
    return table(HEADER, rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print the tables and quote those that are whole."""
    parser = argparse.ArgumentParser(prog="python -m experiments.headroom", description=__doc__)
    parser.add_argument("plants", nargs="*", metavar="PLANT", help="all by default")
    parser.add_argument("--report", type=Path, default=Path("docs"), help="folder of the page")
    options = parser.parse_args(arguments)
    sys.path.append(EXAMPLES)
    groups = {"headroom": CASES}
    if importlib.util.find_spec("pcgym") is not None:
        groups["pcgym"] = PCGYM_CASES
    for mark, cases in groups.items():
        names = [name for name in cases if not options.plants or name in options.plants]
        if not names:
            continue
        text = measure(cases, names)
        print(text, flush=True)
        if len(names) == len(cases):
            marks = f"<!-- {mark}: begin -->\n", f"<!-- {mark}: end -->"
            quote(text, options.report / "headroom.md", *marks)


if __name__ == "__main__":
    main()
