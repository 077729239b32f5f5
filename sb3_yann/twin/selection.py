"""Residuals fitted to a log, and which one counts: the one that free runs held out ask for."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import combinations, product
from threading import Event
from typing import Any, NamedTuple

import numpy as np
import torch as th
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import linalg, optimize
from threadpoolctl import threadpool_limits
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from sb3_yann._progress import bar
from sb3_yann._validation import Array
from sb3_yann.control import LinearModel, LinearMPC, Terminal
from sb3_yann.control.identification.residuals import FOLDS
from sb3_yann.control.linear_system import labels_of
from sb3_yann.control.mpc.coordinates import steady_states
from sb3_yann.twin.dynamics import Coordinates, Dynamics, Residual
from sb3_yann.twin.forecast import ACTUATORS, Actuator, Judge, surely_worse
from sb3_yann.twin.log import Episode, pieces
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.units import FLOAT32_ROUNDING

FAMILY_UPDATES = 1000  # iterations of the fit of a family
CONSTANTS = 2  # numbers that a fit of a family takes to differ from seed to seed

Loss = Callable[[list[th.Tensor]], th.Tensor]  # of the weights of one network


def fit_ensemble(
    coordinates: Coordinates,
    logs: Sequence[Sequence[Episode]],
    seed: int,
    *,
    ahead: int = 1,
    updates: int = 3000,
) -> list[Residual]:
    """Return one network for each log, all fitted at once.

    A linear part is fitted by least squares, the networks to what it leaves of single steps, in a
    tenth of ``updates`` iterations of L-BFGS. With ``ahead`` above 1 these are half as many, and as
    many as that tenth fit all of it to windows of so many steps, along which the model goes on from
    its own predictions: single steps take sensors' noise for dynamics.

    Where an estimator's memory stands for the plant's state, a step leaves loads as well, which
    the MPC answers: a fit would take the answer for the cause. So networks are fitted to what
    episodes of one seed, of the same loads, leave differently, by the same log for each member.
    """
    generator = th.Generator().manual_seed(seed)
    pairs = [_pair(coordinates, log) for log in logs]
    # Single steps of a simulator are known to many digits, those of a log are not.
    dtype = th.float64 if ahead == 1 else th.float32
    alike = _of_one_seed(logs[0]) if coordinates.row.is_estimate else None
    networks = _Networks(pairs, alike, FLOAT32_ROUNDING * coordinates.units, generator, dtype)
    networks.fit_steps(pairs, updates // (10 if ahead == 1 else 20))
    if ahead > 1:
        windows = [_windows(coordinates.row, log, ahead) for log in logs]
        networks.fit_windows(coordinates, windows, updates // 10)
    return networks.residuals()


def fit_family(coordinates: Coordinates, log: Sequence[Episode], seed: int) -> list[Residual]:
    """Return a network for each seed of a log; they differ by constants that no reading shows.

    One network takes these beside all else. Both are fitted at once, from small random
    numbers (P. Bojanowski et al., *Optimizing the latent space of generative networks*, ICML 2018).
    """
    names = [e.seed if e.seed is not None else -1 - i for i, e in enumerate(log)]
    of_row = np.repeat(np.unique(names, return_inverse=True)[1], [*map(len, log)])
    pairs = [_pair(coordinates, log)]
    generator = th.Generator().manual_seed(seed)
    least = FLOAT32_ROUNDING * coordinates.units
    networks = _Networks(pairs, None, least, generator, th.float64, of_row)
    networks.fit_steps(pairs, FAMILY_UPDATES)
    return networks.residuals()


def _pair(coordinates: Coordinates, log: Sequence[Episode]) -> list[Array]:
    """Return z (rows, k) and y (rows, n) of all episodes: see `Coordinates.regression`."""
    pairs = [coordinates.regression(each) for each in log]
    return [np.concatenate(each) for each in zip(*pairs, strict=True)]


class _Networks:
    """The networks while they are fitted, in standardized coordinates.

    Each member is fitted to a pair z, y, or to the differences of rows that are ``alike`` (pairs,
    2); what is smaller in y than ``least`` (n,) is rounding. ``of_row`` (rows,) says which hidden
    constants act in a row: a single network then makes a member for each.
    """

    def __init__(
        self,
        pairs: list[list[Array]],
        alike: NDArray[np.intp] | None,
        least: Array,
        generator: th.Generator,
        dtype: th.dtype,
        of_row: NDArray[np.intp] | None = None,
    ) -> None:
        hidden = 48  # units in each of two hidden layers
        self.alike = alike
        self.of_row = of_row
        self.dtype = dtype
        count = len(pairs)
        k = pairs[0][0].shape[1]
        n = pairs[0][1].shape[1]
        self.center = self.tensor([z.mean(0, keepdims=True) for z, _ in pairs])
        self.width = self.tensor([np.maximum(z.std(0, keepdims=True), 1e-9) for z, _ in pairs])
        compared = [[self._compared(each) for each in pair] for pair in pairs]
        linear, units = zip(*(_least_squares(*each) for each in compared), strict=True)
        self.unit = self.tensor(np.maximum(units, least))

        def drawn(rows: int, columns: int) -> th.Tensor:
            found = th.randn((count, rows, columns), generator=generator, dtype=dtype)
            return found.div(rows**0.5)

        def zeros(rows: int, columns: int) -> th.Tensor:
            return th.zeros((count, rows, columns), dtype=dtype)

        more = CONSTANTS * (of_row is not None)
        self.weights = [drawn(k + more, hidden), zeros(1, hidden), drawn(hidden, hidden)]
        mean = self.tensor([y.mean(0, keepdims=True) for _, y in pairs])
        self.weights += [zeros(1, hidden), zeros(hidden, n), mean / self.unit]
        # Scaled as all else: a step of Adam is small beside what it changes, whatever its unit.
        own = self.tensor(linear) * self.width.mT / self.unit
        self.weights.append(th.cat([own, zeros(more, n)], dim=1))
        if of_row is not None:
            size = 1, int(of_row.max()) + 1, CONSTANTS
            # 0.1: size of the hidden constants that a fit begins with, in standard deviations
            self.weights.append(0.1 * th.randn(size, generator=generator, dtype=dtype))
        for each in self.weights:
            each.requires_grad_()

    def tensor(self, parts: Any) -> th.Tensor:
        """Return arrays as one tensor."""
        return th.as_tensor(np.asarray(parts), dtype=self.dtype)

    def _compared(self, rows: Any) -> Any:
        """Return rows, or the differences of those that are alike."""
        return rows if self.alike is None else rows[self.alike[:, 0]] - rows[self.alike[:, 1]]

    def fit_steps(self, pairs: list[list[Array]], iterations: int) -> None:
        """Fit them to single steps, on all rows."""

        def loss_of(i: int) -> Loss:
            z, y = pairs[i]
            rows = (self.tensor(z) - self.center[i]) / self.width[i]
            wanted = self.tensor(y) / self.unit[i]

            def loss(weights: list[th.Tensor]) -> th.Tensor:
                constants = [] if self.of_row is None else [weights[7][self.of_row]]
                found = _network(weights[:7], th.cat([rows, *constants], dim=1))
                errors: th.Tensor = self._compared(found - wanted)
                return (errors**2).mean()

            return loss

        self._fit(loss_of, iterations)

    def fit_windows(self, of: Coordinates, windows: list[Array], iterations: int) -> None:
        """Fit them to windows (windows, k, steps + 1), going on from their own predictions.

        A window begins at a reading. Its noise goes on as the linear model says, beside that of the
        readings to come, of the same size: generalized least squares allow for it.
        """
        row = of.row
        n = row.problem.model.n_states
        A = row.linear[row.state][:, row.state] / of.units[:, None] * of.units
        linear = self.tensor(row.linear[row.state][:, row.inputs].T)
        low, high, scale = map(self.tensor, (of.low, of.high, of.scale[:, None]))
        turn = None if of.turn is None else self.tensor(of.turn)

        def loss_of(i: int) -> Loss:
            steps = windows[i].shape[-1] - 1
            first, *later = self.tensor(np.moveaxis(windows[i], -1, 0))
            of_start = np.concatenate([np.linalg.matrix_power(A, t + 1) for t in range(steps)])
            noise = np.linalg.cholesky(np.eye(n * steps) + of_start @ of_start.T)
            whitened = self.tensor(np.linalg.inv(noise).T / np.tile(of.units, steps)[:, None])

            def loss(weights: list[th.Tensor]) -> th.Tensor:
                W1, b1, W2, b2, W3, b3, L = self._scaled(weights, i)
                last = th.cat([W3, L / scale, linear])
                W1 = W1 / scale
                row = first
                errors = []
                for after in later:
                    z = row.clamp(low, high)
                    hidden = th.addmm(b2, th.tanh(th.addmm(b1, z, W1)), W2).tanh()
                    x = th.addmm(b3, th.cat([hidden, z, row], dim=1), last)
                    if turn is not None:  # an angle may have jumped
                        turns = (x - after[:, :n]).detach() / th.where(turn > 0, turn, th.inf)
                        x = x - turn * turns.round()
                    errors.append(x - after[:, :n])
                    row = th.cat([x, after[:, n:]], dim=1)
                return steps * ((th.cat(errors, dim=1) @ whitened) ** 2).mean()

            return loss

        self._fit(loss_of, iterations)

    def _fit(self, loss_of: Callable[[int], Loss], iterations: int) -> None:
        """Fit each by itself, side by side, by L-BFGS."""
        count = len(self.unit)
        stopped = Event()
        with (
            bar("networks of a model", total=count * iterations, timed=True) as doing,
            ThreadPoolExecutor() as pool,
        ):

            def done(_: Array) -> None:
                doing.update()
                if stopped.is_set():
                    raise StopIteration

            def fit(i: int) -> None:
                weights = [each.detach()[i].requires_grad_() for each in self.weights]
                loss = loss_of(i)

                def slopes(flat: Array) -> tuple[float, Array]:
                    vector_to_parameters(self.tensor(flat), weights)
                    value = loss(weights)
                    slopes = th.autograd.grad(value, weights)
                    return value.item(), parameters_to_vector(slopes).double().numpy()

                with threadpool_limits(1):  # of this thread
                    # 50: pairs that L-BFGS remembers
                    found = optimize.minimize(
                        slopes,
                        parameters_to_vector(weights).detach().double().numpy(),
                        jac=True,
                        method="L-BFGS-B",
                        options={"maxiter": iterations, "maxcor": 50, "ftol": 0.0},
                        callback=done,
                    )
                vector_to_parameters(self.tensor(found.x), weights)
                for each, fitted in zip(self.weights, weights, strict=True):
                    each.data[i] = fitted

            fits = [pool.submit(fit, i) for i in range(count)]
            try:
                for each in fits:
                    each.result()
            finally:
                stopped.set()  # an interrupt does not wait for fits

    def _scaled(self, weights: Sequence[th.Tensor], i: Any = slice(None)) -> list[th.Tensor]:
        """Return weights in scaled coordinates, of network i or of all."""
        W1, b1, W2, b2, W3, b3, L = weights
        W1 = W1 / self.width[i].mT
        L = L * self.unit[i] / self.width[i].mT
        b1 = b1 - self.center[i] @ W1
        return [W1, b1, W2, b2, W3 * self.unit[i], b3 * self.unit[i] - self.center[i] @ L, L]

    def residuals(self) -> list[Residual]:
        """Return them in scaled coordinates, one by one."""
        with th.no_grad():
            W1, b1, W2, b2, W3, b3, L = self.weights[:7]
            if self.of_row is not None:  # constants move the biases of each member
                constants = self.weights[7].swapaxes(0, 1)  # (members, 1, .)
                k = W1.shape[1] - CONSTANTS
                b1 = b1 + constants @ W1[:, k:]
                b3 = b3 + constants @ L[:, k:]
                W1, W2, b2, W3, L = (
                    each.expand(len(b1), -1, -1) for each in (W1[:, :k], W2, b2, W3, L[:, :k])
                )
            parts = self._scaled([W1, b1, W2, b2, W3, b3, L])
            parts.append(th.zeros((len(L), L.shape[1], L.shape[1] * L.shape[2])))
            arrays = [each.double().numpy().copy() for each in parts]
        return [Residual([each[i] for each in arrays]) for i in range(len(arrays[0]))]


def _windows(row: RowLayout, log: Sequence[Episode], ahead: int) -> Array:
    """Return windows (windows, k, steps + 1) of so many steps of a log, or of its longest episode.

    They are evenly spaced.
    """
    steps = min(ahead, max(map(len, log)))
    whole = [each for each in log if len(each) >= steps]
    total = sum(len(each) - steps + 1 for each in whole)
    # About 500 windows, more where these are farther apart than half of one, at most 1000.
    apart = max(min(steps // 2, total // 500), total // 1000, 1)
    parts = [row.features(e.thetas, np.vstack([e.actions, e.actions[-1:]])) for e in whole]
    return np.concatenate([sliding_window_view(e, steps + 1, axis=0)[::apart] for e in parts])


def _network(weights: Sequence[th.Tensor], z: th.Tensor) -> th.Tensor:
    """Return what networks of standardized z (..., batch, k) are, (..., batch, n)."""
    W1, b1, W2, b2, W3, b3, L = weights
    return th.tanh(th.tanh(z @ W1 + b1) @ W2 + b2) @ W3 + b3 + z @ L


def _least_squares(z: Array, y: Array) -> tuple[Array, Array]:
    """Return the linear part (k, n) of y, and the deviation (1, n) of what it leaves."""
    about = z - z.mean(axis=0)
    y = y - y.mean(axis=0)
    # The ridge of the linear part, relative to the variance of what it is fitted to.
    ridge = 1e-6 * (np.trace(about.T @ about) / z.shape[1] + 1e-300)
    linear = np.linalg.solve(about.T @ about + ridge * np.eye(z.shape[1]), about.T @ y)
    left = y - about @ linear
    return linear, np.sqrt(np.mean(left**2, axis=0, keepdims=True))


def _of_one_seed(log: Sequence[Episode]) -> NDArray[np.intp] | None:
    """Return pairs (pairs, 2) of rows of one seed and time, None where there are none."""
    starts = np.cumsum([0, *map(len, log)])
    found = [
        np.array([[start], [other]]) + np.arange(min(len(e), len(f)))
        for (e, start), (f, other) in combinations(zip(log, starts, strict=False), 2)
        if e.seed == f.seed is not None
    ]
    return np.concatenate(found, axis=1).T if found else None


KINDS = ("none", "linear", "quadratic", "network")  # of polynomials the degree is the number
SHRINKAGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
INPUT_FACTORS = (1.0, 30.0)  # times as strongly inputs are shrunk: closed loops show little of them
GAINS = (0.6, 1.7)  # times the model's: an input may act so, unless the log refutes it


class Setting(NamedTuple):
    """How a polynomial is fitted.

    ``shrinkage`` is the weight of its squared coefficients, times the number of samples; terms with
    an input are shrunk ``factor`` times as strongly, to an effect that is, of one input, the
    ``gain`` times the model's. One that ``drifts`` has a constant term, whatever theta holds.
    """

    degree: int
    shrinkage: float
    factor: float
    gain: tuple[int, float] | None = None
    drifts: bool = False

    def __str__(self) -> str:
        """Name the kind and the shrinkage."""
        strongest = self.shrinkage * self.factor
        return f"{KINDS[self.degree]}, shrinkage {self.shrinkage:g} ({strongest:g} of inputs)"


@dataclass(frozen=True)
class Candidate:
    """A kind of residual: number k has not seen the episodes that are k modulo their count."""

    name: str
    by_fold: tuple[Residual, ...]
    setting: Setting | None = None


def without_each_fold(parts: Sequence[Episode]) -> list[list[Episode]]:
    """Return episodes without each fold of them; none of a single one."""
    folds = range(min(FOLDS, len(parts))) if len(parts) > 1 else ()
    return [[e for i, e in enumerate(parts) if i % FOLDS != k] for k in folds]


def ridge(
    coordinates: Coordinates, episodes: Sequence[Episode], settings: Sequence[Setting]
) -> list[Residual]:
    """Return polynomials of some episodes, one for each setting.

    Where theta holds set-points or disturbances they have a constant term, which is not shrunk:
    else the equilibrium stays where it is.
    """
    z, y = _pair(coordinates, episodes)
    problem = coordinates.row.problem
    (count, k) = z.shape
    constant = bool(problem.layout.has_constants) or any(each.drifts for each in settings)
    F = basis(z, constant, max(each.degree for each in settings))
    gram = F.T @ F
    cross = F.T @ y
    found = []
    for each in settings:
        weight = shrinkage_of(each, problem, k)
        size = len(weight)
        matrix = linalg.cho_factor(gram[:size, :size] + count * np.diag(weight))
        about = np.zeros((size, y.shape[1]))
        if each.gain is not None:
            j, times = each.gain
            at = k - problem.model.n_inputs + j
            about[at] = (times - 1) * coordinates.scale[at] * problem.model.B[:, j]
        solved = about + linalg.cho_solve(matrix, cross[:size] - gram[:size, :size] @ about)
        found.append(Residual.of_basis(solved, k, constant))
    return found


def basis(z: Array, constant: bool, degree: int) -> Array:
    """Return the terms (count, f) of a polynomial of z (count, k): z, one, and products."""
    i, j = np.triu_indices(z.shape[1])
    F = np.hstack([z, np.ones((len(z), int(constant)))])
    return np.hstack([F, z[:, i] * z[:, j]]) if degree > 1 else F


def shrinkage_of(setting: Setting, problem: LinearMPC, k: int) -> Array:
    """Return the weight (f,) of each squared coefficient of a basis of k features."""
    inputs = np.arange(k) >= k - problem.model.n_inputs
    weight = setting.shrinkage * np.where(inputs, setting.factor, 1.0)
    products = weight[np.triu_indices(k)[1]] if setting.degree > 1 else weight[:0]
    constant = [1e-9] * int(problem.layout.has_constants or setting.drifts)
    return np.concatenate([weight, constant, products]) + 1e-12


def candidates(
    coordinates: Coordinates, parts: Sequence[Episode], kinds: Sequence[str], drifts: bool = False
) -> list[Candidate]:
    """Return the model as it is, and polynomials of some kinds, the least free first."""
    kept = without_each_fold(parts)
    degrees = [degree for degree in (1, 2) if KINDS[degree] in kinds]
    choices = product(degrees, SHRINKAGES, INPUT_FACTORS)
    settings = [Setting(*each, drifts=drifts) for each in choices]
    settings.sort(key=lambda s: s.degree - 2 * np.log10(s.shrinkage) - np.log10(s.factor))
    fits = [ridge(coordinates, each, settings) for each in kept if settings]
    zero = Residual.zero(len(coordinates.scale), coordinates.row.problem.model.n_states)
    found = [Candidate("none", (zero,) * len(kept))]
    for number, each in enumerate(settings):
        found.append(Candidate(str(each), tuple(fit[number] for fit in fits), each))
    return found


@dataclass(frozen=True)
class FreeRuns:
    """Errors (candidates, episodes, horizons) of free runs over episodes that were held out.

    They are root mean squares over states, in units of how far each moves in the log.
    """

    horizons: Any
    by_episode: Array

    @property
    def errors(self) -> Array:
        """Root mean squares over all episodes, (candidates, h)."""
        return np.asarray(np.sqrt(np.nanmean(self.by_episode**2, axis=1)))

    @property
    def scores(self) -> Array:
        """The mean logarithm over horizons, (candidates, episodes): less is better."""
        return np.asarray(np.nanmean(np.log(self.by_episode + 1e-12), axis=2))

    def choose(self, first: int = 0) -> int:
        """Return the first candidate, from a number on, within one standard error of the best.

        The error is that of the difference of the two, over episodes (the one-standard-error rule
        of Hastie, Tibshirani and Friedman, section 7.10).
        """
        known = ~np.isnan(self.by_episode).all(axis=(0, 2))  # too short a piece says nothing
        scores = FreeRuns(self.horizons, self.by_episode[first:, known]).scores
        best = int(np.argmin(scores.mean(axis=1)))
        behind = scores - scores[best]
        near = behind.mean(axis=1) <= behind.std(axis=1, ddof=1) / np.sqrt(behind.shape[1])
        near[best] = True
        return first + int(np.argmax(near))


def held_out(
    coordinates: Coordinates, parts: Sequence[Episode], choices: Sequence[Candidate]
) -> FreeRuns:
    """Return the errors of free runs of candidates over episodes, each without its fold."""
    if len(parts) < 2:
        return FreeRuns(np.array([1]), np.full((len(choices), 1, 1), np.inf))
    longest = min(100, int(np.median([*map(len, parts)])))  # steps of a free run, at most
    horizons = np.unique(np.geomspace(min(5, longest), longest, 6).astype(int))
    errors = np.full((len(choices), len(parts), len(horizons)), np.nan)
    # Stepped as one: those with hidden units, and those without.
    plain = np.array([each.by_fold[0].is_polynomial for each in choices])
    alike = [np.flatnonzero(plain == kind) for kind in {*plain.tolist()}]
    for i, episode in enumerate(bar("candidates on held-out episodes", parts)):
        known = horizons[horizons <= len(episode)]  # a short piece says nothing of more
        steps = int(known.max(initial=0))
        # 20: free runs in an episode
        starts = np.unique(np.linspace(0, len(episode) - steps, 20).astype(int))
        actual = episode.thetas[starts[:, None] + known, coordinates.row.state]
        for same in alike:
            members = tuple(choices[j].by_fold[i % FOLDS] for j in same)
            dynamics = Dynamics(coordinates.row.problem, coordinates, members)
            with np.errstate(all="ignore"):
                free = dynamics.replay(episode, starts, steps)[:, :, known]
                mean = np.mean(((free - actual) / coordinates.units) ** 2, axis=(1, 3))
            mean = np.where(np.isfinite(mean), np.minimum(mean, 1e12), 1e12)
            errors[same, i, : len(known)] = mean
    return FreeRuns(horizons, np.sqrt(errors))


def judges(
    coordinates: Coordinates, log: tuple[Episode, ...], chosen: Candidate, scores: Array
) -> tuple[Judge, ...]:
    """Return the twins that a log may not refute: the chosen one, and those with other gains.

    In a closed loop a log may not tell the gain of an input. The others are shrunk little: what the
    chosen one owes to its shrinkage shows as well. ``scores`` (episodes,) are those of its runs.
    """
    problem = coordinates.row.problem
    parts = pieces(log, FOLDS)
    degree = 1 if chosen.setting is None else chosen.setting.degree
    names = labels_of(problem.model)[1]
    gains = [*product(range(len(names)), GAINS)]
    # Around such a gain a log is fitted with little shrinkage, but of its inputs.
    others = [Setting(degree, 1e-3, 1e3, gain) for gain in gains]
    fits = [ridge(coordinates, each, others) for each in without_each_fold(parts)]
    rivals = [
        Candidate(f"a gain of {names[j]} {times:g} times the model's, which the log allows", fitted)
        for (j, times), fitted in zip(gains, zip(*fits, strict=True), strict=True)
    ]
    worse = surely_worse(held_out(coordinates, parts, rivals).scores - scores).tolist()
    every = zip([replace(chosen, name=""), *rivals], [False, *worse], strict=True)
    found = [Judge(Dynamics(problem, coordinates, e.by_fold), e.name, bad) for e, bad in every]
    # Polynomials are as free as the chosen one, or as those that are tried beside networks.
    return (*found, *_behind(coordinates, log, chosen.setting or Setting(2, 1e-4, 1.0)))


def _behind(coordinates: Coordinates, log: tuple[Episode, ...], setting: Setting) -> list[Judge]:
    """Return a twin behind the actuator that predicts one step best, if surely better than none.

    An estimator goes by the inputs themselves: of its rows nothing is said.
    """
    row = coordinates.row
    if row.observer is not None or row.estimator is not None:
        return []

    def tried(actuator: Actuator) -> tuple[Array, tuple[Residual, ...], Actuator]:
        """Return mean logarithms of squared errors (episodes,), each without its fold, and fits."""
        half = row.problem.u_half
        whole = (replace(e, actions=actuator.behind(e.actions, half)) for e in log)
        acting = pieces(tuple(whole), FOLDS)
        fits = [ridge(coordinates, some, [setting])[0] for some in without_each_fold(acting)]
        errors = []
        for i, (z, y) in enumerate(map(coordinates.regression, acting)):
            left = (y - fits[i % FOLDS].predict(z)) / coordinates.units
            errors.append(np.log(np.mean(left**2) + 1e-20))
        return np.array(errors), tuple(fits), actuator

    found = [*map(tried, ACTUATORS)]
    errors, fits, actuator = min(found, key=lambda each: each[0].mean())
    if not surely_worse(found[0][0] - errors):
        return []
    says = f"{actuator} in the actuators"
    return [Judge(Dynamics(row.problem, coordinates, fits), says, actuator=actuator)]


def reidentified(
    problem: LinearMPC, coordinates: Coordinates, log: tuple[Episode, ...]
) -> LinearMPC:
    """Return the MPC of a model shrunk towards the given one: see `PlantTwin.reidentified`.

    Where the plant rests elsewhere, what drifts is fitted beside A and B.
    """
    parts = pieces(log, FOLDS)
    choices = candidates(coordinates, parts, ["linear"])
    if not problem.layout.has_constants:
        choices += candidates(coordinates, parts, ["linear"], drifts=True)[1:]
    choice = choices[held_out(coordinates, parts, choices).choose()]
    if choice.setting is None:
        return problem
    (residual,) = ridge(coordinates, log, [choice.setting])
    middle = np.zeros((1, len(coordinates.scale)))
    model = problem.model
    slopes = residual.jacobian(middle)[0] / coordinates.scale
    A, E, B = np.split(slopes, [model.n_states, slopes.shape[1] - model.n_inputs], axis=1)
    own: dict[str, Any] = {"A": model.A + A, "B": model.B + B}
    own["E"] = model.E + (E if E.size else 0.0)
    if problem.layout.has_constants:  # else the operating point is where it is to be held
        # What drifts acts as a constant disturbance does: at rest ``C x = 0`` despite it.
        drift = residual.predict(middle)[0][:, None]
        drifting = LinearModel(own["A"], own["B"], model.dt, E=drift)
        weights = problem.Q, problem.R, problem.theta_half[problem.layout.state], problem.u_half
        rest = steady_states(drifting, problem.tracking.C, *weights)
        own |= {"x_ss": model.x_ss + rest.x[:, -1], "u_ss": model.u_ss + rest.u[:, -1]}
    note = f"Re-identified from {len(log)} episodes: {choice.name}."
    own |= {"notes": [note], "drift": None, "gains": None}  # what was said of the given one
    found = LinearModel(**{**vars(model), **own})
    terminal = Terminal(set="invariant" if len(problem.terminal.set[1]) else None)
    with warnings.catch_warnings():  # what it is told of boxes that are not its own
        warnings.simplefilter("ignore")
        return replace(problem, model=found, terminal=terminal)
