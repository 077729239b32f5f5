"""An ensemble of small networks as residuals, fitted in torch side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch as th
from numpy.lib.stride_tricks import sliding_window_view

from sb3_yann._validation import Array
from sb3_yann.twin.dynamics import Coordinates
from sb3_yann.twin.log import Episode
from sb3_yann.twin.residuals import Residual

HIDDEN = 48  # units in each of two hidden layers
BATCH = 256  # rows in a step of Adam
WINDOWS = 32  # windows of a log in a step of Adam
RATE = 5e-3  # of Adam at first, for single steps; it falls to zero
ROUNDING = 1e-6  # of float32 observations, in how far the states move
RIDGE = 1e-6  # of the linear part, relative to the variance of what it is fitted to


def fit_ensemble(
    coordinates: Coordinates,
    logs: Sequence[Sequence[Episode]],
    seed: int,
    *,
    ahead: int = 1,
    updates: int = 3000,
) -> list[Residual]:
    """Return one network for each log, all fitted at once.

    A linear part is fitted by least squares, the networks to what it leaves of single steps. With
    ``ahead`` above 1 all of it is then fitted to windows of so many steps, along which the model
    goes on from its own predictions: a fit to single steps takes noise of the sensors for dynamics.

    Parameters
    ----------
    coordinates : Coordinates
        What residuals are scaled by.
    logs : sequence of sequences of Episode
        What each member is fitted to, in rows of the coordinates' layout.
    seed : int
        Of the weights and the batches.
    ahead : int, default 1
        Steps of a window, at most those of the longest episode of any log.
    updates : int, default 3000
        Steps of Adam for single steps; before windows half as many, and for them a fifth.
    """
    generator = th.Generator().manual_seed(seed)
    rows = [[coordinates.regression(each) for each in log] for log in logs]
    pairs = [[np.concatenate(part) for part in zip(*each, strict=True)] for each in rows]
    # Single steps of a simulator are known to many digits, those of a log are not.
    dtype = th.float64 if ahead == 1 else th.float32
    networks = _Networks(pairs, ROUNDING * coordinates.units, generator, dtype)
    networks.fit_steps(pairs, updates if ahead == 1 else updates // 2)
    if ahead > 1:
        networks.fit_windows(coordinates, logs, ahead, updates // 5)
    return networks.residuals()


class _Networks:
    """The networks while they are fitted, in standardized coordinates.

    Parameters
    ----------
    pairs : list of [z (rows, k), y (rows, n)]
        What each member is fitted to.
    least : ndarray, shape (n,)
        What is smaller in y is rounding.
    generator : torch.Generator
    dtype : torch.dtype
    """

    def __init__(
        self, pairs: list[list[Array]], least: Array, generator: th.Generator, dtype: th.dtype
    ) -> None:
        self.generator, self.dtype, count = generator, dtype, len(pairs)
        k, n = pairs[0][0].shape[1], pairs[0][1].shape[1]
        self.center = self.tensor([z.mean(0, keepdims=True) for z, _ in pairs])
        self.width = self.tensor([np.maximum(z.std(0, keepdims=True), 1e-9) for z, _ in pairs])
        linear, units = zip(*(_least_squares(*each) for each in pairs), strict=True)
        self.unit = self.tensor(np.maximum(units, least))

        def drawn(rows: int, columns: int) -> th.Tensor:
            shape = (count, rows, columns)
            found: th.Tensor = th.randn(shape, generator=generator, dtype=dtype)
            return found.div(rows**0.5)

        def zeros(rows: int, columns: int) -> th.Tensor:
            return th.zeros((count, rows, columns), dtype=dtype)

        self.weights = [drawn(k, HIDDEN), zeros(1, HIDDEN), drawn(HIDDEN, HIDDEN)]
        mean = self.tensor([y.mean(0, keepdims=True) for _, y in pairs])
        self.weights += [zeros(1, HIDDEN), zeros(HIDDEN, n), mean / self.unit]
        # Scaled as all else: a step of Adam is small beside what it changes, whatever its unit.
        self.weights.append(self.tensor(linear) * self.width.mT / self.unit)
        for each in self.weights:
            each.requires_grad_()

    def tensor(self, parts: Any) -> th.Tensor:
        """Return arrays as one tensor."""
        return th.as_tensor(np.asarray(parts), dtype=self.dtype)

    def __call__(self, z: th.Tensor) -> th.Tensor:
        """Return what the networks make of z (members, batch, k)."""
        W1, b1, W2, b2, W3, b3, L = self.weights
        z = (z - self.center) / self.width
        first = th.tanh(z @ W1 + b1)
        out: th.Tensor = (th.tanh(first @ W2 + b2) @ W3 + b3 + z @ L) * self.unit
        return out

    def fit_steps(self, pairs: list[list[Array]], updates: int) -> None:
        """Fit them to single steps."""
        z, y = (self.tensor(_same_length([each[i] for each in pairs])) for i in (0, 1))
        for _ in self._steps(RATE, updates):
            chosen = th.randint(z.shape[1], (BATCH,), generator=self.generator)
            (((self(z[:, chosen]) - y[:, chosen]) / self.unit) ** 2).mean().backward()  # type: ignore[no-untyped-call]

    def fit_windows(
        self, coordinates: Coordinates, logs: Sequence[Sequence[Episode]], ahead: int, updates: int
    ) -> None:
        """Fit them to windows of the logs, along which they go on from their own predictions."""
        row = coordinates.row
        ahead = min(ahead, *(max(map(len, log)) for log in logs))  # each log has such a window
        n = row.problem.model.n_states
        windows = []
        for log in logs:
            whole = [each for each in log if len(each) >= ahead]
            parts = [row.features(e.thetas, np.vstack([e.actions, e.actions[-1:]])) for e in whole]
            windows.append(
                np.concatenate([sliding_window_view(p, ahead + 1, axis=0) for p in parts])
            )
        data = self.tensor(_same_length(windows))  # (members, windows, k, ahead + 1)
        linear = self.tensor(row.linear[row.state][:, row.inputs].T)
        low, high, scale, units = (
            self.tensor(each)
            for each in (coordinates.low, coordinates.high, coordinates.scale, coordinates.units)
        )
        turn = self.tensor(np.zeros(n) if coordinates.turn is None else coordinates.turn)
        per_turn = th.where(turn > 0, 1 / turn, 0.0)
        for _ in self._steps(RATE / 5, updates):
            chosen = th.randint(data.shape[1], (WINDOWS,), generator=self.generator)
            window = data[:, chosen]
            x, loss = window[..., :n, 0], th.zeros((), dtype=self.dtype)
            for t in range(ahead):
                features = th.cat([x, window[..., n:, t]], dim=-1)
                x = features @ linear + self(features.clamp(low, high) / scale)
                after = window[..., :n, t + 1]
                x = x - turn * ((x - after) * per_turn).detach().round()  # an angle may have jumped
                loss = loss + (((x - after) / units) ** 2).mean()
            loss.backward()  # type: ignore[no-untyped-call]

    def _steps(self, rate: float, updates: int) -> Iterator[None]:
        """Yield before each gradient; then step."""
        adam = th.optim.Adam(self.weights, lr=rate)
        schedule = th.optim.lr_scheduler.CosineAnnealingLR(adam, max(updates, 1))
        for _ in range(updates):
            adam.zero_grad()
            yield
            th.nn.utils.clip_grad_norm_(self.weights, 10.0)
            adam.step()
            schedule.step()

    def residuals(self) -> list[Residual]:
        """Return them in scaled coordinates, one by one."""
        with th.no_grad():
            W1, b1, W2, b2, W3, b3, L = self.weights
            first, L = W1 / self.width.mT, L * self.unit / self.width.mT
            b1 = b1 - self.center @ first
            b3 = b3 * self.unit - self.center @ L
            parts = [first, b1, W2, b2, W3 * self.unit, b3, L]
            parts.append(th.zeros((len(L), L.shape[1], L.shape[1] * L.shape[2])))
            arrays = [each.double().numpy().copy() for each in parts]
        return [Residual([each[i] for each in arrays]) for i in range(len(arrays[0]))]


def _least_squares(z: Array, y: Array) -> tuple[Array, Array]:
    """Return the linear part (k, n) of y, and the deviation (1, n) of what it leaves."""
    about, y = z - z.mean(axis=0), y - y.mean(axis=0)
    ridge = RIDGE * (np.trace(about.T @ about) / z.shape[1] + 1e-300)
    linear = np.linalg.solve(about.T @ about + ridge * np.eye(z.shape[1]), about.T @ y)
    left = y - about @ linear
    size = np.sqrt(np.mean(left**2, axis=0, keepdims=True))
    return linear, size


def _same_length(parts: list[Array]) -> Array:
    """Return arrays (rows, ...) as one (members, rows, ...): short ones are repeated."""
    longest = max(map(len, parts))
    return np.array([each[np.arange(longest) % len(each)] for each in parts])
