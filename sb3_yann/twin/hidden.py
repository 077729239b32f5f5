"""States that no sensor shows, and what the plant does beyond its model, from outputs alone.

Free runs of the plant's own states, window by window, shall show the logged outputs: multiple
shooting (H. Bock, in *Modelling of Chemical Reaction Systems*, Springer 1981) by Levenberg and
Marquardt's method. Where each window begins is unknown, and so is the residual.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.twin.dynamics import Coordinates, Residual
from sb3_yann.twin.log import Episode
from sb3_yann.twin.selection import Setting, basis, shrinkage_of

SHOOTING_STEPS = (5, 15, 60)  # steps of the windows: long ones begin where short ones have led
GUESS = 1e-5  # weight of the given states where windows begin, beside the outputs'


def shoot(
    coordinates: Coordinates,
    episodes: Sequence[Episode],
    setting: Setting,
    # Weight of states that another fit found: the hidden ones keep their coordinates.
    trust: float = 1e-2,
) -> tuple[Residual, list[Episode]]:
    """Return the residual of the plant's states, and episodes with the states that it found.

    Those of the given ones show their outputs, and are a guess else. So do those that are found.
    """
    row = coordinates.row
    assert row.observer is not None
    C = row.observer.C
    state = row.state
    units = coordinates.units
    # 3.0: times the largest magnitude in the log, of a residual while it is fitted
    box = 3.0 * coordinates.scale
    wide = replace(coordinates, low=-box, high=box)
    constant = row.problem.layout.has_constants
    price = sum(map(len, episodes)) * shrinkage_of(setting, row.problem, len(box))
    weights: Array = np.zeros((len(price), len(units)))
    found = [each.thetas[:, state] for each in episodes]
    for steps in SHOOTING_STEPS:
        at = [np.arange(0, len(e), steps)[:, None] + np.arange(steps + 1) for e in episodes]
        every = [*zip(episodes, at, strict=True)]
        given = np.concatenate([e.thetas[np.minimum(i, len(e)), state] for e, i in every])
        inputs = [e.actions[np.minimum(i[:, :-1], len(e) - 1)] for e, i in every]
        counts = np.concatenate([i <= len(e) for e, i in every])[..., None]
        run = partial(_run, wide, setting.degree, np.concatenate(inputs))
        target = C, given @ C.T, counts / (np.abs(C) @ units), given[:, 0] / units
        begin = np.concatenate([x[i[:, 0]] for x, i in zip(found, at, strict=True)]) / units
        weights, begin = _descended(run, target, weights, begin, price, trust)
        parts = np.split(run(weights, begin)[0], np.cumsum([len(i) for i in at])[:-1])
        # The last row of a window is the first one of the next, where there is one.
        found = [
            np.vstack([x[:, :-1].reshape(-1, len(units))[: len(e)], x[-1, len(e) - i[-1, 0]]])
            for x, (e, i) in zip(parts, every, strict=True)
        ]
    made = []
    for each, x in zip(episodes, found, strict=True):
        rows = each.thetas.copy()
        rows[:, state] = x + (rows[:, state] - x) @ row.measured.T
        made.append(Episode(rows, each.actions))
    return Residual.of_basis(weights * units, len(box), constant), made


def _run(
    coordinates: Coordinates, degree: int, inputs: Array, weights: Array, begin: Array
) -> tuple[Array, Array]:
    """Return states (N, S + 1, n), and slopes (N, S + 1, n, n + f n) by beginnings and weights.

    Weights (f, n) of a basis and beginnings (N, n) are in units of the states.
    """
    row = coordinates.row
    units = coordinates.units
    n = len(units)
    step = row.linear[row.state][:, row.inputs]
    constant = row.problem.layout.has_constants
    residual = Residual.of_basis(weights * units, len(coordinates.scale), constant)
    x = begin * units
    f = len(weights)
    moved: Array = np.zeros((len(x), n, n + f * n))
    moved[:, :, :n] = np.diag(units)
    states = [x]
    slopes = [moved]
    for t in range(inputs.shape[1]):
        rows = np.concatenate([x, inputs[:, t]], axis=1)
        z = coordinates.scaled(rows)
        moved = (step + residual.jacobian(z) / coordinates.scale)[..., :n] @ moved
        terms = basis(z, constant, degree)
        for j in range(n):
            moved[:, j, n + j * f : n + (j + 1) * f] += terms * units[j]
        x = rows @ step.T + residual.predict(z)
        states.append(x)
        slopes.append(moved)
    return np.stack(states, axis=1), np.stack(slopes, axis=1)


def _descended(
    run: Callable[[Array, Array], tuple[Array, Array]],
    target: tuple[Array, Array, Array, Array],
    weights: Array,
    begin: Array,
    price: Array,
    trust: float,
) -> tuple[Array, Array]:
    """Return weights (f, n) and beginnings (N, n) whose runs miss the outputs least.

    The ``target`` is C (q, n), outputs (N, S + 1, q), how much they count, and a guess (N, n).
    """
    C, outputs, scale, guess = target
    n = begin.shape[1]
    prices = np.tile(price, n)

    def judged(weights: Array, begin: Array) -> tuple[float, Array, Array]:
        with np.errstate(all="ignore"):
            x, slopes = run(weights, begin)
            e = (x @ C.T - outputs) * scale
            J = C @ slopes * scale[..., None]
            cost = np.sum(e**2) + trust * np.sum((begin - guess) ** 2)
            cost += np.sum(price[:, None] * weights**2)
        flat = e.reshape(len(e), -1, 1), J.reshape(len(J), -1, J.shape[-1])
        return float(np.nan_to_num(cost, nan=np.inf)), *flat

    damping = 1e-2
    cost, e, J = judged(weights, begin)
    for _ in range(15):  # corrections, at most
        of_begin, of_weights = np.split(J, [n], axis=2)
        own = of_begin.swapaxes(1, 2) @ of_begin + trust * np.eye(n)
        cross = of_weights.swapaxes(1, 2) @ of_begin
        flat = of_weights.reshape(-1, of_weights.shape[-1])
        H = flat.T @ flat + np.diag(prices)
        g = flat.T @ e.ravel() + prices * weights.T.ravel()
        slope = of_begin.swapaxes(1, 2) @ e + trust * (begin - guess)[..., None]
        before = cost
        while damping < 1e8:
            right = np.concatenate([cross.swapaxes(1, 2), slope], axis=2)
            solved = np.linalg.solve(own * (1 + damping * np.eye(n)), right)
            # Beginnings are eliminated: each one meets its own window alone.
            reduced = np.sum(cross @ solved, axis=0)
            left = H + damping * np.diag(np.diag(H)) - reduced[:, :-1]
            move = np.linalg.solve(left, reduced[:, -1] - g)
            tried = weights + move.reshape(n, -1).T
            start = begin - solved[..., -1] - solved[..., :-1] @ move
            cost, *now = judged(tried, start)
            if cost < before:
                break
            damping *= 10
        else:
            break
        weights = tried
        begin = start
        e, J = now
        damping = max(damping / 10, 1e-9)
        # 1e-3: a search is done when a correction saves less than this part of its errors
        if before - cost < 1e-3 * before:
            break
    return weights, begin
