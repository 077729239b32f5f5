"""What the self-test of exported code plays, and what the controller does there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.deployment.code import (
    Arrays,
    input_ranges,
    insensitive,
    room_of,
    room_outside,
    sample_observations,
    table,
)
from sb3_yann.deployment.controller import MODES, Controller


def known_answers(data: Arrays, precision: str) -> dict[str, str]:
    """Return what the self-test in C is filled with: points and steps, and what they must give.

    ValueError if a rounding changes all answers.
    """
    controller, n_points = Controller(data), 48
    drawn = sample_observations(controller, 4 * n_points)
    if precision == "float":
        drawn = drawn.astype(np.float32).astype(np.float64)
    obs = insensitive(controller, drawn, precision)[:n_points]
    room = room_of(data, precision)
    if not len(obs):
        raise ValueError(
            f"In {precision} a rounding of a reading moves the output by more than {room:g} of its "
            "range, at all points tried: readings are large beside what they move by. Pass "
            "precision='double'."
        )
    ranges = input_ranges(controller, controller.evaluate(drawn))
    run = Run.with_estimator(data, obs) if "est_gain" in data else Run.of_readings(obs)
    answers, room_in_loop = run.play(controller), 0.0
    if run.plant:
        # What roundings of the outputs do to the loop, code may do too.
        moved = run.play(controller, 1e-6 if precision == "float" else 1e-13)
        change = np.abs(moved["actions"] - answers["actions"]) / ranges
        room_in_loop = 10 * float(change.max())
    numbers: dict[str, NDArray[Any]] = {
        "points": obs,
        "policy": controller.evaluate(obs),
        "law": controller.evaluate(obs, networks=False),
        "range_of": ranges,
        "readings": run.readings,
        "elapsed": run.elapsed,
        **{key: each for key, each in run.plant.items() if each.size},
        "lost": run.lost,
        "starts_anew": run.starts_anew,
        "requests": run.requests,
        **answers,
    }
    texts = [
        table("yann_real" if each.dtype.kind == "f" else "int", name, each, precision)
        for name, each in numbers.items()
    ]
    n_outputs, n_states = run.plant["C_of_plant"].shape if run.plant else (0, 0)
    sizes = {"POINTS": len(obs), "STEPS": len(run.lost), "STATES": n_states, "OUTPUTS": n_outputs}
    sizes["LOADS"] = len(run.plant["loads_of_plant"]) if run.plant else 0
    return {
        "VECTORS": "\n".join(texts),
        **{key: str(size) for key, size in sizes.items()},
        "ROOM_INSIDE": f"{room:g}",
        "ROOM_OUTSIDE": f"{room_outside(data, precision):g}",
        "ROOM_IN_LOOP": f"{room_in_loop:.2g}",
    }


@dataclass(frozen=True)
class Run:
    """Steps of a controller with lost readings, a late one, all modes and a second start.

    Attributes
    ----------
    readings : ndarray, shape (T, n_read)
        Where there is a plant, its outputs are added to the first ones.
    elapsed, lost, requests, starts_anew : ndarray, shape (T,)
        Whether the first reading is lost, and whether the controller starts anew: the plant's input
        takes it then.
    plant : dict of str to ndarray
        ``x+ = step_of_plant [x; u; loads; 1]`` from ``start_of_plant``, with the outputs
        ``C_of_plant x``; empty where there is none.
    """

    readings: Array
    elapsed: Array
    lost: NDArray[np.bool_]
    requests: NDArray[np.int64]
    starts_anew: NDArray[np.bool_]
    plant: dict[str, NDArray[Any]]

    @classmethod
    def of_readings(cls, readings: Array, count: int = 60, **plant: NDArray[Any]) -> Run:
        """Return so many steps, each reading for four of them."""
        k = np.arange(count)
        return cls(
            readings=readings[k // 4 % len(readings)],
            elapsed=np.where(k == 20, 3.0, 1.0),
            lost=((k >= 10) & (k < 13)) | ((k >= 30) & (k < 40)),
            requests=np.select([(k >= 50) & (k < 53), (k >= 56) & (k < 60)], [1, 2], 0),
            starts_anew=k == count - 15,
            plant=plant,
        )

    @classmethod
    def with_estimator(cls, data: Arrays, seen: Array) -> Run:
        """Return a closed loop with the estimator's own model as the plant.

        It begins beside the operating point, with a load that the estimator must find; references
        and measured loads change.
        """
        (size, q), source, rest = data["est_gain"].shape, data["source"], data["obs_rest"]
        half = (data["box"][1] - data["box"][0]) / 2
        x = data["est_first"] @ np.append(rest[:q], 1.0)
        spread = np.zeros(size)
        readings = np.tile(rest, (50, 1))
        for column, place in enumerate(source):
            if len(rest) <= place < len(rest) + size:
                spread[place - len(rest)] = half[column]
            elif place < len(rest):
                steps = seen[np.arange(50) // 5 % len(seen), column]
                readings[:, place] += 0.1 * (steps - rest[place])
        noise = np.random.default_rng(0).normal(size=(50, q))
        readings[:, :q] = 1e-3 * noise * (np.abs(data["est_C"]) @ spread)
        scale, shift = data["est_input"]
        step = data["est_next"].copy()
        step[:, -1] += step[:, size : size + len(scale)] @ shift
        step[:, size : size + len(scale)] *= scale
        return cls.of_readings(
            readings,
            200,
            step_of_plant=step,
            C_of_plant=data["est_C"],
            start_of_plant=x + 0.2 * spread,
            loads_of_plant=data["est_loads"],
        )

    def play(self, controller: Controller, moved: float = 0.0) -> dict[str, NDArray[Any]]:
        """Return actions (T, m), status and modes; outputs move by a part of their size."""
        controller.reset()
        generator = np.random.default_rng(2)
        x = self.plant["start_of_plant"] if self.plant else np.zeros(0)
        actions: list[Array] = []
        status, modes = [], []
        for k, reading in enumerate(self.readings.copy()):
            given = reading.copy()
            if self.plant:
                y = self.plant["C_of_plant"] @ x
                given[: len(y)] += y * (1 + moved * generator.choice([-1, 1], len(y)))
            if self.lost[k]:
                given[0] = np.nan
            if self.starts_anew[k]:
                controller.reset()
            controller.request = MODES[self.requests[k]]
            present = actions[-1] if self.starts_anew[k] else None
            actions.append(controller(given, self.elapsed[k], present))
            status.append(int(controller.status))
            modes.append(MODES.index(controller.mode))
            if self.plant:
                loads = reading[self.plant["loads_of_plant"]]
                x = self.plant["step_of_plant"] @ [*x, *actions[-1], *loads, 1.0]
        return {
            "actions": np.array(actions),
            "status": np.array(status),
            "modes": np.array(modes),
        }
