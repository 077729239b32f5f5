"""Are corrupted logs refused, and sound ones not? `python -m experiments.corrupted_logs`.

Each log is of 5 to 15 episodes, of the MPC, of the MPC with a dither, or of inputs in open loop.
A corrupted one that the twin trusts is given to `improve`, and what that accepts is played on the
plant. Prints one row for each corruption: how many logs, how many of them trusted, how many
accepted, and the largest change of the cost on the plant in %.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from examples import quadruple_tank as tank
from experiments import plants
from sb3_yann import LinearModel, LinearMPC, PlantTwin, Tracking, improve
from sb3_yann._validation import Array
from sb3_yann.improvement.simulator import in_deviations
from sb3_yann.wrappers import SetPoint

Log = list[tuple[Array, Array]]
HOW = "MPC", "MPC with dither", "open loop"


class Plant(gym.Env[Array, Array]):
    """A plant with a function (x, u) -> next x, all of it in deviations."""

    def __init__(self, mpc: LinearMPC, advance: Callable[[Array, Array], Array], spread: Any):
        self.mpc = mpc
        self.advance = advance
        self.spread = np.array(spread)
        self.x = 0 * self.spread
        self.action_space = gym.spaces.Box(mpc.u_min, mpc.u_max, dtype=np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, self.x.shape, np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, dict]:
        """Begin around the operating point."""
        super().reset(seed=seed)
        self.x = self.spread * self.np_random.uniform(-1, 1, len(self.spread))
        return self.x.copy(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict]:
        """Hold the inputs for a sample."""
        self.x = self.advance(self.x, np.clip(action, self.mpc.u_min, self.mpc.u_max))
        return self.x.copy(), 0.0, False, False, {}


def linear(A: Any, B: Any, gain: Any, spread: Any, **options: Any) -> tuple[LinearMPC, Any]:
    """Return the MPC of a linear model, and what makes the plant with inputs of another gain."""
    mpc = LinearMPC(LinearModel(A, B, 1.0), **options)
    A = mpc.model.A
    B = mpc.model.B * gain
    return mpc, lambda: Plant(mpc, lambda x, u: A @ x + B @ u, spread)


def two_lags() -> tuple[LinearMPC, Any]:
    """Return the plant of tests/twin/test_alignment.py."""
    options = {"Q": np.diag([2.0, 1.0]), "R": 0.2 * np.eye(2), "horizon": 3, "u_min": -1}
    A = [[0.9, 0.15], [0, 0.7]]
    B = [[0.1, 0], [0.05, 0.3]]
    return linear(A, B, [1.5, 0.7], [1.5, 1.5], **options, u_max=1, x_min=-4, x_max=4)


def twice_the_gain() -> tuple[LinearMPC, Any]:
    """Return two coupled lags whose gains are twice the model's."""
    options = {"Q": np.diag([1, 2]), "R": 0.1 * np.eye(2), "horizon": 2, "u_min": -1, "u_max": 1}
    A = [[0.85, 0.1], [0.05, 0.8]]
    B = [[0.2, 0.05], [0.02, 0.25]]
    return linear(A, B, [2, 2], [1.2, 1.2], **options, x_min=-2, x_max=2)


def reactor() -> tuple[LinearMPC, Any]:
    """Return CSTR-v0."""
    make = lambda: gym.make("CSTR-v0")  # noqa: E731
    return make().observation_space.problem, make  # type: ignore[attr-defined]


def heater() -> tuple[LinearMPC, Any]:
    """Return a heater with two samples of dead time: its past inputs are states."""
    A = [[0.92, 0.4, 0], [0, 0, 1], [0, 0, 0]]
    B = [[0], [0], [1]]
    options = {"Q": np.diag([1, 0, 0]), "R": [[0.1]], "horizon": 4, "u_min": -3, "u_max": 3}
    mpc, _ = linear(A, B, 1, [6, 0, 0], **options, theta_min=[-15, -3, -3], theta_max=[15, 3, 3])
    A = mpc.model.A * [[1, 1.3, 1], [1, 1, 1], [1, 1, 1]]
    loss = lambda x: np.array([0.002 * x[0] ** 2, 0, 0])  # noqa: E731
    return mpc, lambda: Plant(mpc, lambda x, u: A @ x + mpc.model.B @ u - loss(x), [6, 0, 0])


def motor() -> tuple[LinearMPC, Any]:
    """Return angle and speed of a motor with .5 of the model's torque, and friction."""
    A = [[1, 0.1], [0, 0.9]]
    B = [[0.01], [0.2]]
    options = {"Q": np.diag([1, 0.1]), "R": [[0.05]], "horizon": 5, "u_min": -2, "u_max": 2}
    mpc, _ = linear(A, B, 1, [1, 1], **options, theta_min=[-3, -4], theta_max=[3, 4])
    drag = lambda x: np.array([0, 0.01 * x[1] ** 3])  # noqa: E731
    advance = lambda x, u: mpc.model.A @ x + 0.5 * mpc.model.B @ u - drag(x)  # noqa: E731
    return mpc, lambda: Plant(mpc, advance, [1, 1])


def worn_tank() -> tuple[LinearMPC, Any]:
    """Return four tanks whose pumps have lost a quarter, with set-points of the lower levels."""
    rest = np.array([12.4, 12.7, 1.8, 1.4])
    u = np.array(tank.VOLTAGES_SS)
    slope = lambda x, v: np.array(tank.derivative(x, v))  # noqa: E731
    model = LinearModel.from_dynamics(slope, [np.nan] * 4, u, tank.DT)
    rest = model.x_ss
    model = LinearModel(model.A, model.B, tank.DT)  # in deviations, as the plant
    mpc = LinearMPC(
        model, Q=np.diag([1, 1, 0, 0]), R=0.1 * np.eye(2), horizon=3, gamma=0.98, u_min=-3, u_max=3,
        tracking=Tracking([0, 1], [-2, -2], [2, 2]), theta_min=-rest, theta_max=20 - rest,
    )  # fmt: skip
    advance = lambda x, v: np.array(tank.advance(rest + x, u + v, wear=0.25)) - rest  # noqa: E731
    spread = [2, 2, 0.5, 0.5]
    return mpc, lambda: SetPoint(Plant(mpc, advance, spread), [-2, -2], [2, 2], hold=20)


def textbook(make: Callable[[], plants.TextbookPlant]) -> tuple[LinearMPC, Any]:
    """Return the MPC of a textbook's plant, and what makes the plant, both in deviations."""
    plant = make()
    mpc = plant.mpc()
    return mpc.deviations, in_deviations(lambda: plant.env(mpc), mpc)


PLANTS: dict[str, Callable[[], tuple[LinearMPC, Any]]] = {
    "two lags": two_lags,
    "twice the gain": twice_the_gain,
    "reactor": reactor,
    "heater": heater,
    "motor": motor,
    "worn tank": worn_tank,
    "conical tank": lambda: textbook(plants.conical_tank),
    "van de Vusse": lambda: textbook(plants.van_de_vusse),
}


def stuck(x: Array) -> Array:
    """Return states of which the first reads the same for a quarter of the rows."""
    x = x.copy()
    first = len(x) // 3
    x[first : first + len(x) // 4 + 1, 0] = x[first, 0]
    return x


def changed(i: int, factor: float = 1.0, offset: float = 0.0) -> Callable[..., Any]:
    """Return a corruption of a state, whose offset is in standard deviations."""

    def corrupt(x: Array, u: Array, half: Array, unit: Array) -> tuple[Array, Array]:
        x = x.copy()
        x[:, i % len(unit)] = factor * x[:, i % len(unit)] + offset * unit[i]
        return x, u

    return corrupt


def states_exchanged(x: Array, u: Array, half: Array, unit: Array) -> tuple[Array, Array]:
    """Return the columns of the states in reverse; references stay."""
    n = len(unit)
    return np.hstack([x[:, n - 1 :: -1], x[:, n:]]), u


FAULTS: dict[str, Callable[[Array, Array, Array, Array], tuple[Array, Array]]] = {
    "a row early": lambda x, u, half, unit: (x[:-1], u[1:]),
    "a row late": lambda x, u, half, unit: (x[1:], u[:-1]),
    "inputs exchanged": lambda x, u, half, unit: (x, u[:, ::-1] * half / half[::-1]),
    "states exchanged": states_exchanged,
    "an input negated": lambda x, u, half, unit: (x, u * np.where(np.arange(len(half)), 1, -1)),
    "a state negated": changed(0, -1),
    "inputs times .3": lambda x, u, half, unit: (x, 0.3 * u),
    "inputs times .55": lambda x, u, half, unit: (x, 0.55 * u),
    "inputs times 1.8": lambda x, u, half, unit: (x, 1.8 * u),
    "inputs times .01": lambda x, u, half, unit: (x, 0.01 * u),
    "fractions of the range": lambda x, u, half, unit: (x, 0.5 * half + 0.5 * u),
    "an input's zero": lambda x, u, half, unit: (x, u + 0.2 * half),
    "a state's zero": changed(0, offset=1.0),
    "Fahrenheit": changed(0, 1.8, 1.0),
    "a state in other units": changed(-1, 0.4),
    "a frozen sensor": lambda x, u, half, unit: (stuck(x), u),
    "every second row": lambda x, u, half, unit: (x[::2][: len(u) // 2 + 1], u[::2][: len(u) // 2]),
}


def play(
    act: Callable[[Array], Array], mpc: LinearMPC, env: Any, seed: int, noise: float = 0.0
) -> tuple[Array, Array]:
    """Return theta (41, p) and inputs (40, m) of an episode; the sensors may be noisy."""
    theta = env.reset(seed=seed)[0]
    rng = np.random.default_rng(seed)
    measured = np.count_nonzero(np.hstack([mpc.model.A, mpc.model.B]), axis=1) > 1
    scale = noise * mpc.theta_half
    scale[mpc.layout.state] *= measured
    scale[mpc.model.n_states :] = 0
    thetas = [theta + scale * rng.normal(size=len(theta))]
    inputs = []
    for _ in range(40):
        inputs.append(np.clip(act(thetas[-1]), mpc.u_min, mpc.u_max))
        theta = env.step(inputs[-1])[0]
        thetas.append(theta + scale * rng.normal(size=len(theta)))
    return np.array(thetas), np.array(inputs)


def log(mpc: LinearMPC, make: Callable[[], Any], how: str, seed: int) -> Log:
    """Return a log."""
    rng = np.random.default_rng(seed)
    law = mpc.law()
    env = make()
    size = 0.25 * np.minimum(mpc.u_max, -mpc.u_min)
    held = [size]

    def act(theta: Array) -> Array:
        if how != "open loop":
            dither = 0.5 * size * rng.normal(size=len(size)) if how != "MPC" else 0.0
            return np.asarray(law(theta) + dither)
        if rng.random() < 0.2:
            held.append(2 * size * rng.uniform(-1, 1, len(size)))
        return held[-1]

    n = int(rng.choice([5, 8, 15]))
    return [play(act, mpc, env, 1000 * seed + i, 0.002 * (seed % 2)) for i in range(n)]


def fitted(mpc: LinearMPC, episodes: Log, n_members: int = 1) -> PlantTwin | None:
    """Return the twin; None where the log cannot be read."""
    kinds = ["none", "linear", "quadratic"]
    try:
        return PlantTwin.fit(mpc, episodes, residuals=kinds, n_members=n_members)
    except ValueError:
        return None


def improved(mpc: LinearMPC, make: Any, twin: PlantTwin) -> float | None:
    """Return the change of the cost on the plant, in %; None where nothing is accepted."""
    found = improve(mpc, twin, n_starts=20)
    if not found.accepted:
        return None
    act = lambda theta: found.model.predict(theta.astype(np.float32), deterministic=True)[0]  # noqa: E731
    costs = [
        sum(np.sum(mpc.stage_cost(t[:-1], u)) for t, u in (play(each, mpc, make(), 9000 + i)
            for i in range(60))) for each in (act, mpc.law())
    ]  # fmt: skip
    return float(100 * (costs[0] / costs[1] - 1))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m experiments.corrupted_logs")
    parser.add_argument("--plants", nargs="+", default=[*PLANTS], choices=[*PLANTS])
    parser.add_argument("--improve", action="store_true", help="where a corrupted log is trusted")
    options = parser.parse_args()
    rows: dict[str, list[tuple[bool, float | None]]] = {}
    for name in options.plants:
        mpc, make = PLANTS[name]()
        for k, how in enumerate(HOW):
            for seed in range(5):
                twin = fitted(mpc, log(mpc, make, how, 10 * k + seed))
                rows.setdefault(f"sound, {how}", []).append((bool(twin and twin.trusted), None))
                if not (twin and twin.trusted):
                    said = twin.trust.problems if twin else "unreadable"
                    print(name, "|", how, "|", seed, "|", said, file=sys.stderr, flush=True)
            half = np.minimum(mpc.u_max, -mpc.u_min)
            for number, (fault, corrupt) in enumerate(FAULTS.items()):
                episodes = log(mpc, make, how, 100 + 10 * k + number % 5)
                unit = np.std(np.concatenate([x for x, _ in episodes]), axis=0)
                unit = unit[: mpc.model.n_states]
                bad = [corrupt(x, u, half, unit) for x, u in episodes]
                if all(
                    a.shape == c.shape and np.allclose(a, c) and np.allclose(b, d)
                    for (a, b), (c, d) in zip(episodes, bad, strict=True)
                ):
                    continue  # one input or state
                twin = fitted(mpc, bad)
                change = None
                if twin and twin.trusted:
                    if options.improve:
                        change = improved(mpc, make, fitted(mpc, bad, 3))
                    print(name, "|", how, "|", fault, "|", change, file=sys.stderr, flush=True)
                rows.setdefault(fault, []).append((bool(twin and twin.trusted), change))
    print(
        "| log | logs | trusted | accepted | cost on the plant, % |\n"
        "| --- | ---: | ---: | ---: | --- |"
    )
    for fault, found in rows.items():
        changes = [each for _, each in found if each is not None]
        worst = f"{min(changes):+.2f} to {max(changes):+.2f}" if changes else ""
        trusted = sum(each for each, _ in found)
        print(f"| {fault} | {len(found)} | {trusted} | {len(changes)} | {worst} |")


if __name__ == "__main__":
    main()
