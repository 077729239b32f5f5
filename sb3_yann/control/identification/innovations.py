"""Models in innovation form from outputs and inputs: subspace estimates and prediction errors.

An ARX model of many lags predicts one step ahead, in closed loop as in open loop. Its predictions
over a future window factor into an observability matrix and a state, which is a linear function of
the past (Chiuso, *The role of vector autoregressive modeling in predictor-based subspace
identification*, Automatica 43, 2007). Prediction errors refine the matrices (Ljung, *System
Identification*, 2nd ed., section 7.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import fdtrc

from sb3_yann._validation import Array
from sb3_yann.control.gains import count_integrators, responses
from sb3_yann.control.identification.least_squares import Regression, regress
from sb3_yann.control.lqr import spectral_radius
from sb3_yann.log import Episode

LAGS = (1, 2, 4, 6, 9, 13, 19, 28)  # lags of the ARX models that are tried
CHANCE = 0.001  # significance level of the effects of inputs
CHANCES = (CHANCE, 1e-6)  # the levels that are tried
FLOOR = 1e-14  # variance, relative to the output's, below which all is rounding
TINY_RIDGE = 1e-9  # of the number of steps: lags of a log without noise depend on each other


@dataclass(frozen=True, eq=False)
class Innovations:
    """``x[k+1] = A x[k] + B v[k] + c + K e[k]``, ``y[k] = C x[k] + y_0 + e[k]``.

    Where some outputs are read now and then only, ``sparse``, K and the noise are those of the
    samples at which they are.
    """

    A: Array  # (n, n)
    B: Array  # (n, m + d)
    K: Array  # (n, q)
    C: Array  # (q, n)
    c: Array  # (n,)
    y_0: Array  # (q,)
    noise: Array  # (q, q), covariance of e
    sparse: bool = False

    @property
    def order(self) -> int:
        """Number of states n."""
        return len(self.A)

    @property
    def inner(self) -> Array:
        """``A - K C``, which predicts from measured outputs."""
        return self.A - self.K @ self.C


def shifted(episodes: Sequence[Episode], delays: Sequence[int]) -> list[Episode]:
    """Return the episodes with the inputs moved down by their dead times, in one piece each."""
    late = max(delays, default=0)
    found = []
    for each in episodes:
        if len(each) <= late:
            continue
        inputs = np.column_stack(
            [each.inputs[late - lag : len(each) - lag, j] for j, lag in enumerate(delays)]
        )
        found.append(Episode(each.states[late:], inputs, each.disturbances[late:]))
    return found


def with_lags(episodes: Sequence[Episode], lags: int, start: int) -> list[Episode]:
    """Return episodes that begin at ``start``, with ``lags - 1`` earlier samples as disturbances.

    A regressor is ``[y[k], v[k], y[k-1], v[k-1], ...]``.
    """
    found = []
    for each in episodes:
        if len(each) <= start:
            continue
        past = [each.regressors[start - lag : len(each) - lag] for lag in range(1, lags)]
        more = np.hstack([each.driven[start:, each.inputs.shape[1] :], *past])
        found.append(Episode(each.states[start:], each.inputs[start:], more))
    return found


def arx(episodes: Sequence[Episode], lags: int, start: int) -> Regression:
    """Return the ARX model of so many lags; a row of its regressors is as of `with_lags`."""
    rows = with_lags(episodes, lags, start)
    return regress(rows, ridge=TINY_RIDGE * sum(map(len, rows)))


def lags_by_criterion(episodes: Sequence[Episode]) -> tuple[int, Regression]:
    """Return how many lags, by Akaike's criterion, and the ARX model with them."""
    width = episodes[0].regressors.shape[1]
    q = episodes[0].states.shape[1]
    sizes = np.array([*map(len, episodes)])
    rows = {p: np.maximum(sizes - p + 1, 0).sum() for p in LAGS}
    tried = [p for p in LAGS if rows[p] > max(3 * p * width + 10, sizes.sum() / 2)] or [1]

    def criterion(p: int) -> float:
        found = arx(episodes, p, tried[-1] - 1)
        return float(found.steps * np.linalg.slogdet(above_rounding(found))[1] + 2 * q * p * width)

    lags = min(tried, key=criterion)
    # The state needs a longer past than the criterion's.
    lags = max(lags, min(tried[-1], max(4, round(1.5 * lags))))
    return lags, arx(episodes, lags, lags - 1)


def long_arx(episodes: Sequence[Episode], limit: int) -> tuple[int, Regression]:
    """Return how many lags, more than a dead time of ``limit``, and the ARX model with them."""
    lags, found = lags_by_criterion(episodes)
    width = episodes[0].regressors.shape[1]
    # 2: rows for each coefficient, at least
    enough = (
        p
        for p in range(lags, limit + 5)
        if sum(len(e) - p for e in episodes if len(e) > p) > 2 * p * width
    )
    longest = max(enough, default=lags)
    return (lags, found) if lags >= longest else (longest, arx(episodes, longest, longest - 1))


def dead_times(
    episodes: Sequence[Episode], limit: int, n_driven: int | None = None
) -> list[tuple[int, ...]]:
    """Return for each input how many of its latest values have no effect on the next output.

    With ``n_driven`` for so many of the inputs and disturbances.

    A test that their coefficients in a long ARX model are zero, for one sample more as long as
    it does not speak against it, at each of the levels ``CHANCES``: among many inputs and outputs
    one that is too strict ends it too early.
    """
    q = episodes[0].states.shape[1]
    m = n_driven or episodes[0].inputs.shape[1]
    lags, found = long_arx(episodes, limit)
    width = episodes[0].regressors.shape[1]
    columns = [[lag * width + q + j for lag in range(lags)] for j in range(m)]
    # What never acts has no dead time.
    idle = [no_effect(found, each, CHANCE) for each in columns]
    delays = []
    for chance in CHANCES:
        dead = [0] * m
        for j, each in enumerate(columns):
            longest = 0 if idle[j] else min(limit, lags - 1)
            while dead[j] < longest and no_effect(found, each[: dead[j] + 1], chance):
                dead[j] += 1
        delays.append(tuple(dead))
    return delays


def above_rounding(found: Regression) -> Array:
    """Return the covariance (n, n) of residuals, the variances above what rounding makes."""
    spread = found.spread[: len(found.reached)]
    return found.covariance + np.diag(FLOOR * np.where(spread > 0, spread, 1.0) ** 2)


def no_effect(found: Regression, of: Sequence[int] | Array, chance: float) -> bool:
    """Return whether an F test cannot tell coefficients from zero.

    It is of some columns, or of weighted sums of all columns, (k, columns). Of one it is
    Hotelling's T-squared test.
    """
    weights = of if isinstance(of, np.ndarray) else np.eye(found.coefficients.shape[1])[list(of)]
    b = found.coefficients @ weights.T
    own = weights @ found.correlation @ weights.T + np.finfo(float).tiny * np.eye(len(weights))
    inner = np.linalg.solve(own, b.T)
    wald = float(np.sum(np.linalg.solve(above_rounding(found), b) * inner.T))
    freedom = found.degrees_of_freedom - len(b) + 1
    return bool(fdtrc(b.size, freedom, wald * freedom / b.size / found.degrees_of_freedom) > chance)


class Past:
    """The state of each order as a linear function of the past, by predictor-based subspaces.

    Inputs are moved by their dead times. For ``rare`` outputs (q,) there are stand-ins.
    """

    def __init__(self, episodes: Sequence[Episode], rare: NDArray[np.bool_] | None = None) -> None:
        self.rare = np.zeros(episodes[0].states.shape[1], bool) if rare is None else rare
        p, self.arx = lags_by_criterion(episodes)
        q = episodes[0].states.shape[1]
        self.width = episodes[0].regressors.shape[1]
        self.rows = with_lags(episodes, p, p - 1)
        past = [each.regressors - self.arx.center for each in self.rows]
        whiten = linalg.inv(linalg.cholesky(above_rounding(self.arx), lower=True))
        block = whiten @ self.arx.coefficients
        # What the past says of the output i samples on, beside what comes in between.
        future = np.zeros((p * q, p * self.width))
        for i in range(p):
            future[i * q : (i + 1) * q, : (p - i) * self.width] = block[:, i * self.width :]
        whole = np.concatenate(past)
        r = linalg.qr(whole / np.sqrt(len(whole)), mode="r")[0][: whole.shape[1]]
        left, sizes, _ = np.linalg.svd(future @ r.T, full_matrices=False)
        self.limit = int(np.sum(sizes > 1e-6 * sizes[0]))
        to_state = (left[:, : self.limit] / np.sqrt(sizes[: self.limit])).T @ future
        self.states = [each @ to_state.T for each in past]  # row k is the state at k + 1

    def idle(self) -> list[int]:
        """Return the inputs and disturbances without effect that can be distinguished from zero."""
        q = len(self.arx.reached)
        lags = self.arx.center.size // self.width
        return [
            j
            for j in range(self.width - q)
            if no_effect(self.arx, [q + j + lag * self.width for lag in range(lags)], CHANCE)
        ]

    def model(self, order: int) -> Innovations:
        """Return the model of an order, by least squares between these states."""
        n = order
        x = np.concatenate([each[:, :n] for each in self.states])
        y = np.concatenate([each.states[1:] for each in self.rows])
        q = y.shape[1]
        driven = self.width - q
        C = np.linalg.lstsq(x, y - self.arx.reached, rcond=None)[0].T
        moves = [
            Episode(state[:, :n], each.driven[1:, :driven], each.states[1:-1])
            for state, each in zip(self.states, self.rows, strict=True)
            if len(state) > 1
        ]
        found = regress(moves, ridge=TINY_RIDGE * sum(map(len, moves)))
        inner, B, K = np.split(found.coefficients, [n, n + driven], axis=1)
        errors = y - self.arx.reached - x @ C.T
        noise = errors.T @ errors / len(errors)
        c = found.predict(np.zeros((1, n + driven + q)))[0] + K @ self.arx.reached
        A = inner + K @ C
        some = ~self.rare
        own = noise + FLOOR * np.eye(q)
        K[:, self.rare] = 0.0  # stand-ins tell nothing of it
        if some.any() and spectral_radius(A - K @ C) >= 1:
            # The gain of the filter for what these states and outputs miss is stable.
            spread = K @ noise @ K.T + found.covariance
            cross = K @ noise[:, some]
            at = np.ix_(some, some)
            spread = (spread + spread.T) / 2
            C_some = C[some]
            P = linalg.solve_discrete_are(A.T, C_some.T, spread, own[at], s=cross)
            shown = A @ P @ C_some.T + cross
            K[:, some] = np.linalg.solve(C_some @ P @ C_some.T + own[at], shown.T).T
        return Innovations(A, B, K, C, c, self.arx.reached, own, bool(self.rare.any()))


class Chunks:
    """Stretches of a log, side by side, in which prediction errors are computed.

    The first state of each is a free vector, which a projection takes out (Golub and Pereyra,
    *Separable nonlinear least squares*, Inverse Problems 19, 2003). An output that is NaN is
    replaced by its prediction.
    """

    def __init__(self, episodes: Sequence[Episode]) -> None:
        parts = []
        for each in episodes:
            # 2000: longest stretch of samples whose first state is estimated on its own
            count = -(-len(each) // 2000)
            edges = np.linspace(0, len(each) + 1, count + 1).round().astype(int)
            driven = np.vstack([each.driven, np.zeros((1, each.driven.shape[1]))])
            parts += [(each.states[a:b], driven[a:b]) for a, b in pairwise(edges) if b - a > 1]
        shape = len(parts), max(len(y) for y, _ in parts)
        self.y = np.zeros((*shape, parts[0][0].shape[1]))
        self.v = np.zeros((*shape, parts[0][1].shape[1]))
        self.there = np.zeros((*shape, 1))
        for i, (y, v) in enumerate(parts):
            self.y[i, : len(y)] = y
            self.v[i, : len(y)] = v
            self.there[i, : len(y)] = 1.0
        read = np.isfinite(self.y)
        self.read = read * self.there
        self.lost = ~read * self.there
        self.y[~read] = 0.0
        self.samples = int(self.there.sum())
        self.readings: Array = self.read.sum(axis=(0, 1))
        self.rare: NDArray[np.bool_] = self.readings < self.samples

    def forgets(self, model: Innovations) -> bool:
        """Return whether errors of the states decay, with and without the rare outputs.

        Within a chunk, or half as fast as the model forgets: one that never does has made of each
        first state, which is free, a constant that no other record has.
        """
        often = ~self.rare
        between = model.A - model.K[:, often] @ model.C[often]
        # 20.0: errors of a filter's states fall to exp(-20) within a chunk
        slowest = max(1 - 20.0 / self.y.shape[1], (1 + spectral_radius(model.A)) / 2)
        return spectral_radius(model.inner) < min(slowest, 1) and spectral_radius(between) < 1

    def covariance(self, model: Innovations) -> Array:
        """Return the mean square (q, q) of the prediction errors, the first states by its noise."""
        weight = whitening(model.noise, self.readings)
        inside = self.there[..., 0] > 0
        with np.errstate(all="ignore"):
            left = self._simulate(model, weight)[0].reshape(self.y.shape)[inside]
            return mean_square(left @ np.linalg.inv(weight).T, self.read[inside] > 0)

    def spread(self, model: Innovations) -> tuple[Array, Array]:
        """Return mean (n,) and covariance (n, n) of the states."""
        weight = whitening(model.noise, self.readings)
        x = self._simulate(model, weight)[1][self.there[..., 0] > 0]
        return x.mean(axis=0), np.atleast_2d(np.cov(x.T, bias=True))

    def gauss_newton(self, model: Innovations) -> tuple[Array, Array]:
        """Return the normal equations of a step: the matrix (p, p) and the right side (p,)."""
        n = model.order
        (count, length, q) = self.y.shape
        weight = whitening(model.noise, self.readings)
        left, x, basis, inverse = self._simulate(model, weight)
        ones = np.ones((count, length, 1))
        shown = self.read * (self.y - model.y_0) + self.lost * (x @ model.C.T)
        signals = np.concatenate([x, self.v, shown, ones], axis=2)
        w = signals.shape[2]
        slopes: Array = np.zeros((count, length, q, n * w + q * n + q))
        blocks = np.einsum("op,sti->stopi", np.eye(q), x).reshape(count, length, q, q * n)
        slopes[..., n * w : n * w + q * n] = blocks
        slopes[..., n * w + q * n :] = np.eye(q)
        inner = model.inner
        C = model.C
        rows = np.arange(n)
        moved: Array = np.zeros((count, n, w, n))
        by_C: Array = np.zeros((count, n, q * n + q))  # what C and y_0 do where y is predicted
        for k in range(length):
            flat = moved.reshape(count, n, w * n)
            slopes[:, k, :, : n * w] = C @ flat
            moved = (inner @ flat).reshape(count, n, w, n)
            moved[:, rows, :, rows] += signals[:, k]
            if self.rare.any():
                gain = model.K * self.lost[:, k, None, :]
                slopes[:, k, :, n * w :] += C @ by_C
                moved += (gain @ slopes[:, k, :, : n * w]).reshape(count, n, w, n)
                by_C = inner @ by_C + gain @ slopes[:, k, :, n * w :]
        slopes = (weight @ slopes) * self.read[..., None]
        wide: Array = slopes.reshape(count, length * q, -1)
        wide = wide - basis @ (inverse @ wide)
        flat_slopes = wide.reshape(count * length * q, -1)
        return flat_slopes.T @ flat_slopes, flat_slopes.T @ left.ravel()

    def _simulate(self, model: Innovations, weight: Array) -> tuple[Array, Array, Array, Array]:
        """Return weighted errors, states, and what first states do to errors, with its inverse."""
        n = model.order
        (count, length, q) = self.y.shape
        inner = model.inner
        C = model.C
        K = model.K
        errors = self.read * (self.y - model.y_0)
        fed = self.v @ model.B.T + errors @ K.T + model.c
        free = np.zeros((count, length, n, n))
        x: Array = np.zeros((count, length, n))
        now: Array = np.zeros((count, n))
        power: Array = np.tile(np.eye(n), (count, 1, 1))
        for k in range(length):
            x[:, k] = now
            free[:, k] = power
            now = now @ inner.T + fed[:, k]
            power = inner @ power
            if self.rare.any():
                lost = self.lost[:, k]
                now = now + (lost * (x[:, k] @ C.T)) @ K.T
                power = power + K @ (lost[:, :, None] * (C @ free[:, k]))
        basis = ((weight @ (C @ free)) * self.read[..., None]).reshape(count, length * q, n)
        left = ((errors - self.read * (x @ C.T)) @ weight.T) * self.read
        left = left.reshape(count, length * q, 1)
        inverse = np.linalg.pinv(basis, rcond=1e-10)
        first = inverse @ left
        x = x + np.einsum("stij,sj->sti", free, first[..., 0])
        return np.asarray(left - basis @ first), x, basis, np.asarray(inverse, np.float64)


def whitening(noise: Array, readings: Array) -> Array:
    """Return the matrix (q, q) that makes errors white: those read more often come first.

    Where one that is read less often is missing, theirs are still white.
    """
    order = np.argsort(-readings, kind="stable")
    at = np.ix_(order, order)
    found = np.zeros_like(noise)
    found[at] = linalg.inv(linalg.cholesky(noise[at], lower=True))
    return found


def log_determinant(noise: Array, readings: Array) -> float:
    """Return that of a covariance, each output as often as it is read.

    Of prediction errors it is twice the negative log-likelihood of a sample, but for a constant.
    """
    share = readings / np.max(readings)
    try:
        return float(-2 * np.sum(share * np.log(np.diag(whitening(noise, readings)))))
    except (linalg.LinAlgError, ValueError):
        return np.inf


def mean_square(errors: Array, read: NDArray[np.bool_]) -> Array:
    """Return the mean square (q, q) of errors (T, q); correlations where all are read."""
    whole = errors[np.all(read, axis=1)]
    found = whole.T @ whole / max(len(whole), 1)
    size = np.sqrt(np.sum(np.where(read, errors, 0.0) ** 2, axis=0) / np.sum(read, axis=0))
    own = np.sqrt(np.diag(found))
    scale = np.where(own > 0, size / np.where(own > 0, own, 1.0), 0.0)
    return np.asarray(scale[:, None] * found * scale)


def moved_by(model: Innovations, step: Array) -> Innovations:
    """Return the model whose parameters differ by a step of `Chunks.gauss_newton`."""
    n = model.order
    q = len(model.C)
    driven = model.B.shape[1]
    w = n + driven + q + 1
    change = step[: n * w].reshape(w, n).T
    inner, B, K, c = np.split(change, [n, n + driven, n + driven + q], axis=1)
    C = model.C + step[n * w : n * w + q * n].reshape(q, n)
    K = model.K + K
    y_0 = step[n * w + q * n :]
    return replace(
        model,
        A=model.inner + inner + K @ C,
        B=model.B + B,
        K=K,
        C=C,
        c=model.c + c[:, 0] + K @ y_0,  # the predictor's constant moves by c alone
        y_0=model.y_0 + y_0,
    )


def refined(model: Innovations, chunks: Chunks) -> Innovations:
    """Return the model of least determinant of its prediction errors' covariance near a model."""
    floor = FLOOR * np.eye(len(model.C))
    model = replace(model, noise=chunks.covariance(model) + floor)
    size = log_determinant(model.noise, chunks.readings)
    damping = 1e-4
    for _ in range(15):
        matrix, side = chunks.gauss_newton(model)
        scale = np.sqrt(np.diag(matrix)) + 1e-12 * np.sqrt(np.max(np.diag(matrix)))
        before = size
        while damping < 1e4:
            scaled = matrix / np.outer(scale, scale) + damping * np.eye(len(side))
            trial = moved_by(model, np.linalg.solve(scaled, side / scale) / scale)
            if chunks.forgets(trial):
                noise = chunks.covariance(trial) + floor
                finite = np.all(np.isfinite(noise))
                now = log_determinant(noise, chunks.readings) if finite else np.inf
                if now < size:
                    model = replace(trial, noise=noise)
                    size = now
                    damping = max(damping / 10, 1e-9)
                    break
            damping *= 10
        if (before - size) * chunks.samples < 0.1:  # of twice the log-likelihood
            break
    return model


def errors_of(model: Innovations, chunks: Chunks) -> tuple[Array, Array, int, Array]:
    """Return poles (n,), largest first, their errors, integrators, errors of responses (4, q, k).

    To first order, by the inverse of the normal equations (Ljung, *System Identification*, section
    9.4). What only changes the states' coordinates has no effect on either. Where errors of the
    states do not decay, those of poles are inf, and those of `responses` 0.
    """
    with np.errstate(all="ignore"):
        matrix, side = chunks.gauss_newton(model)
    scale = np.sqrt(np.diag(matrix))
    scale = np.where(scale > 0, scale, 1.0)
    inverse = np.full(matrix.shape, np.nan)
    if np.all(np.isfinite(matrix)):
        inverse = np.linalg.pinv(matrix / np.outer(scale, scale), rcond=1e-9, hermitian=True)
    steps = 1e-3 * np.eye(len(side))
    sides = [[moved_by(model, each / scale) for each in (step, -step)] for step in steps]
    dA = np.array([up.A - down.A for up, down in sides]) / 2e-3

    def deviation(slopes: Array) -> Array:
        square = np.einsum("p...,pq,q...->...", np.conj(slopes), inverse, slopes)
        return np.asarray(np.sqrt(np.abs(square)))

    def output_responses(moved: Innovations) -> Array:
        return np.asarray(moved.C @ responses(moved.A, moved.B, count))

    values, left, right = linalg.eig(model.A, left=True, right=True)
    overlap = np.sum(left.conj() * right, axis=0)
    with np.errstate(all="ignore"):
        by_pole = np.einsum("nf,pnm,mf->pf", left.conj(), dA, right)
        of_poles = deviation(by_pole) / np.maximum(np.abs(overlap), 1e-300)
        count = count_integrators(
            model.A, lambda R: float(np.nan_to_num(deviation(np.einsum("ij,pji->p", R, dA))))
        )
        moves = [output_responses(up) - output_responses(down) for up, down in sides]
        errors = deviation(np.array(moves) / 2e-3)
    of_poles = np.nan_to_num(of_poles, nan=np.inf)
    order = np.argsort(-np.abs(values), kind="stable")
    return values[order], of_poles[order], count, np.nan_to_num(errors, posinf=0.0)


def filtered(model: Innovations, outputs: Array, moved: Array, start: tuple[Array, Array]) -> Array:
    """Return the states (T + 1, n) that the outputs before each sample tell.

    The filter begins with a mean (n,) and a covariance (n, n), and goes on without readings that
    are NaN. ``moved`` (T, n) is ``B v + c`` of each step. Where some outputs are read now and then
    the gain is K throughout.
    """
    A = model.A
    C = model.C
    K = model.K
    noise = model.noise
    there: NDArray[np.bool_] = np.isfinite(outputs)
    whole: NDArray[np.bool_] = np.all(there, axis=1)
    x = np.empty((len(outputs), model.order))
    x[0] = start[0]
    P: Array | None = start[1]
    cross = K @ noise
    for k, step in enumerate(moved):
        left = outputs[k] - model.y_0 - C @ x[k]
        if model.sparse or (P is None and whole[k]):
            x[k + 1] = A @ x[k] + step + K @ np.where(there[k], left, 0.0)
            continue
        P = np.zeros_like(A) if P is None else P
        seen = there[k]
        gain = np.zeros_like(K)
        if seen.any():
            S = (C @ P @ C.T + noise)[np.ix_(seen, seen)]
            unit = np.sqrt(np.diag(S))  # outputs of any unit
            covariance = (A @ P @ C.T + cross)[:, seen] / unit
            scaled = np.linalg.lstsq(S / np.outer(unit, unit), covariance.T, rcond=1e-13)[0]
            gain[:, seen] = scaled.T / unit
        x[k + 1] = A @ x[k] + step + gain[:, seen] @ left[seen]
        # The error moves by A - gain C and (K - gain) e: a sum of squares stays one.
        inner = A - gain @ C
        P = inner @ P @ inner.T + (K - gain) @ noise @ (K - gain).T
        if whole[k] and np.max(np.abs(gain - K)) < 1e-9 * (1 + np.max(np.abs(K))):
            P = None  # the innovation form is the filter's limit
    return x
