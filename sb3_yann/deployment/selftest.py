"""Known answers, with which exported code tests itself."""

from __future__ import annotations

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.deployment.c_text import table
from sb3_yann.deployment.controller import MODES, Controller
from sb3_yann.deployment.rounding import ROOM

POINTS, STEPS = 48, 60


def points(controller: Controller, count: int, seed: int = 0) -> Array:
    """Return observations (count, n_obs): the operating point, then some in and around the box."""
    data, generator = controller.data, np.random.default_rng(seed)
    low, high = data["box"]
    theta = (low + high) / 2 + generator.uniform(-0.65, 0.65, (count, len(low))) * (high - low)
    theta[0] = 0.0
    return np.asarray((theta - data["obs_offset"]) @ np.linalg.pinv(data["obs_matrix"]).T)


def steady(controller: Controller, obs: Array, precision: str) -> Array:
    """Return the rows of obs whose answer a rounding of the observation does not change.

    A policy with a network for each region jumps from one to the next.
    """
    size = 1e-6 if precision == "float" else 1e-13
    scale = np.abs(obs).max(0)
    here, kept = controller.evaluate(obs), np.ones(len(obs), bool)
    half = _range_of(controller, here) / 2
    for sign in (-1, 1):
        for j in range(obs.shape[1]):
            moved = obs.copy()
            moved[:, j] += sign * 2 * size * scale[j]
            change = np.abs(controller.evaluate(moved) - here) / half
            kept &= (change < ROOM[precision]).all(1)
            kept &= controller.in_domain(moved) == controller.in_domain(obs)
    steady: Array = obs[kept]
    return steady


def _range_of(controller: Controller, actions: Array) -> Array:
    """Return the ranges of the inputs (m,), of those without bounds what the actions span."""
    scale, bounds = controller.data["action_scale"], controller.data["bounds"]
    largest = np.abs(actions - controller.data["action_shift"]).max(0)
    half: Array = np.where(np.isfinite(bounds).all(0), scale, np.maximum(scale, largest))
    return 2 * half


def vectors(controller: Controller, precision: str) -> dict[str, str]:
    """Return the entries of the C self-test.

    ValueError if a rounding changes all answers.
    """
    drawn = points(controller, 4 * POINTS)
    if precision == "float":
        drawn = drawn.astype(np.float32).astype(np.float64)
    obs = steady(controller, drawn, precision)[:POINTS]
    if not len(obs):
        raise ValueError(
            f"In {precision} a rounding of a reading moves the output by more than "
            f"{ROOM[precision]:g} of its range, at all points tried: readings are large beside "
            "what they move by. Pass precision='double', or export without absolute=True."
        )
    walked = Controller(controller.data)
    rows: list[Array] = []
    found = []
    for k in range(STEPS):
        seen = obs[k // 4 % len(obs)].copy()
        if 10 <= k < 13 or 30 <= k < 40:
            seen[0] = np.nan
        walked.request = MODES[1] if 50 <= k < 53 else MODES[2] if k >= 56 else MODES[0]
        action = walked(seen, elapsed=3.0 if k == 20 else 1.0)
        found.append([*action, int(walked.status), MODES.index(walked.mode)])
        rows.append(seen)
    answers = np.array(found)
    m = len(controller.data["action_scale"])
    range_of = _range_of(controller, controller.evaluate(drawn))
    late = np.where(np.arange(STEPS) == 20, 3.0, 1.0)
    requests = np.array([1 if 50 <= k < 53 else 2 if k >= 56 else 0 for k in range(STEPS)])
    numbers = {
        "points": obs,
        "policy": controller.evaluate(obs),
        "law": controller.evaluate(obs, networks=False),
        "readings": np.nan_to_num(np.array(rows), nan=0.0),
        "elapsed": late,
        "actions": answers[:, :m],
        "range_of": range_of,
    }
    whole = {
        "lost": np.isnan(np.array(rows)[:, 0]).astype(np.int64),
        "requests": requests,
        "status": answers[:, m].astype(np.int64),
        "modes": answers[:, m + 1].astype(np.int64),
    }
    texts = [table("yann_real", name, each, precision) for name, each in numbers.items()]
    texts += [table("int", name, each, precision) for name, each in whole.items()]
    return {
        "VECTORS": "\n".join(texts),
        "POINTS": str(len(obs)),
        "STEPS": str(STEPS),
        "ROOM": f"{ROOM[precision]:g}",
    }
