"""A watchdog: says within an episode that the plant is no longer what its twin describes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array, check_array, check_type
from sb3_yann.control.identification.residuals import FOLDS
from sb3_yann.control.linear_system import labels_of
from sb3_yann.twin.dynamics import Dynamics
from sb3_yann.twin.log import pieces
from sb3_yann.twin.plant_twin import PlantTwin

CHART_GAINS = np.array([1.0, 0.2, 0.05, 0.02])  # without a memory; with 5, 20 and 50 samples
FROZEN = 3  # repeats of a reading from which on it may be frozen


@dataclass(frozen=True)
class Alarm:
    """Why the plant should go back to its MPC, and a message for people.

    The kind is "not a number", "violation", "outside the band", "drift" or "frozen sensor".
    """

    kind: str
    message: str


class Bands:
    """How far charts may go while all is well, from episodes of a log that a fit has not seen.

    ``unseen`` are fits without each fold of the episodes, ``low`` and ``high`` (k,) the box of
    logged features ``[x, d, u]``. Of each state (n,) ``size`` is what the residual explains,
    ``error`` the root mean square of one-step errors. ``spread`` (gains, n) are typical deviations
    of the charts, ``most`` the largest ratios to their scale, which are exceeded by ``factor`` only
    where something is wrong. A ``noisy`` (n,) sensor's errors change from step to step; a reading
    ``repeats`` itself so often in a row in the log.
    """

    def __init__(self, twin: PlantTwin) -> None:
        if not twin.judges:
            raise ValueError(
                "The twin's log is one episode: nothing is left to calibrate a watchdog on. Log "
                "at least one episode more; four are a good number."
            )
        self.unseen = twin.judges[0].dynamics
        log = pieces(twin.episodes, FOLDS)
        row = self.unseen.row
        units = self.unseen.coordinates.units
        left = []
        for i, each in enumerate(log):
            one = replace(self.unseen, members=(self.unseen.members[i % FOLDS],))
            after = one.step(each.thetas[None, :-1], each.actions[None])[0]
            left.append((each.thetas[1:] - after)[:, row.state])
        squares = np.sum([np.sum(each**2, axis=0) for each in left], axis=0)
        products = np.sum([np.sum(each[1:] * each[:-1], axis=0) for each in left], axis=0)
        # Errors of a model change slowly, and noise does not.
        self.noisy = products / np.maximum(squares, 1e-300) < 0.3
        self.error = np.maximum(np.sqrt(squares / sum(map(len, left))), 1e-9 * units)
        explained = [twin.dynamics.residual(e.thetas[None, :-1], e.actions[None])[0] for e in log]
        # The residual is taken to be a tenth of a standard deviation at least.
        least = (0.1 * self.error) ** 2
        self.size = np.sqrt(np.mean(np.concatenate(explained) ** 2, axis=0) + least)
        seen = np.concatenate([row.features(e.thetas[:-1], e.actions) for e in log])
        self.low = seen.min(axis=0)
        self.high = seen.max(axis=0)
        charted = []
        for each, errors in zip(log, left, strict=True):
            charts: Array = np.zeros((2, len(CHART_GAINS), len(units)))
            for step in zip(errors, self.doubt(each.thetas[:-1], each.actions), strict=True):
                charts = charted_with(charts, *step)
                charted.append(charts)
        means, doubted = np.moveaxis(np.array(charted), 1, 0)
        # A median: where an episode leaves what the others show, the doubt explains its errors.
        # The median of a normal distribution's absolute values is .6745 standard deviations.
        self.spread = np.median(np.abs(means), axis=0) / 0.6745 + 1e-9 * self.error
        most = np.max(np.abs(means) / np.hypot(self.spread, doubted), axis=0)
        self.most = np.maximum(most, 0.5)  # the largest ratio is taken to be at least this
        self.repeats = np.max([_repeats(e.thetas[:, row.state]) for e in twin.episodes], axis=0)
        # A band is twice the largest held-out ratio; of few episodes that maximum says less.
        self.factor = 2.0 + 7.5 / len(twin.episodes)

    def doubt(self, rows: Array, u: Array) -> Array:
        """Return how far the twin may be wrong, (..., n), at rows (..., size) and u (..., m).

        It is the standard deviation of the fits, and beyond the box also the ``size`` of what the
        residual explains, times the distance in widths.
        """
        z = self.unseen.row.features(rows, u)
        width = np.maximum(self.high - self.low, 1e-6 * self.unseen.coordinates.scale)
        beyond = np.maximum(np.maximum(z - self.high, self.low - z), 0.0)
        far = (beyond / width).sum(axis=-1, keepdims=True)
        far = far + far**2  # a twin of a narrow log underrates what is far away
        flat = (each.reshape(1, -1, each.shape[-1]) for each in (rows, u))
        apart = self.unseen.residual(*flat).std(axis=0).reshape(*far.shape[:-1], -1)
        return np.asarray(np.hypot(apart, far * self.size))

    def ratios(self, charts: Array) -> Array:
        """Return charts (2, gains, n) in units of their bands: beyond 1 something is wrong."""
        means, doubts = charts
        return np.asarray(means / (self.factor * self.most * np.hypot(self.spread, doubts)))


def charted_with(charts: Array, innovation: Array, doubt: Array) -> Array:
    """Return exponentially weighted averages (2, gains, n) with one sample more (Roberts 1959).

    They are of innovations, and of what is not known, (n,) each.
    """
    return charts + CHART_GAINS[:, None] * (np.array([innovation, doubt])[:, None] - charts)


def _repeats(x: Array) -> NDArray[np.int64]:
    """Return how often in a row, at most, each column repeats its entry."""
    run, longest = np.zeros((2, x.shape[1]), np.int64)
    for same in x[1:] == x[:-1]:
        run = (run + 1) * same
        longest = np.maximum(longest, run)
    return longest


@dataclass(eq=False, repr=False)
class Watchdog:
    """Compares each transition of the plant with what its twin predicts.

    Innovations are charted at several gains, in bands that come from episodes of the log that the
    fit has not seen, and widen where the log shows little. A reading that repeats itself while the
    twin moves is frozen.

    Make one with :meth:`of`, anew after each fit of the twin. It holds nothing from one episode
    to the next; ``alarm`` is the first one of this episode, if there is one.

    Examples
    --------
    >>> import gymnasium
    >>> from sb3_yann import PlantTwin
    >>> from sb3_yann.evaluation import evaluate
    >>> law = (problem := gymnasium.make("CSTR-v0").observation_space.problem).explicit()
    >>> log = evaluate(law, "CSTR-v0", seeds=range(6))
    >>> x, u = log.observations[5], log.actions[5]
    >>> twin = PlantTwin.fit(problem, [*zip(log.observations[:5], log.actions)], updates=200)
    >>> dog = Watchdog.of(twin)
    >>> dog.start(x[0])
    >>> any(dog.watch(x[k], u[k], x[k + 1]) for k in range(200))
    False
    >>> dog.watch(x[200], u[200], x[201] + [0, 0, 0, 5]).kind
    'outside the band'
    """

    dynamics: Dynamics
    bands: Bands
    alarm: Alarm | None = None
    _row: Array | None = field(default=None, init=False)

    @classmethod
    def of(cls, twin: PlantTwin) -> Watchdog:
        """Return a twin's watchdog, calibrated on its log: ValueError if that is one episode."""
        check_type("twin", twin, PlantTwin, "a PlantTwin")
        return cls(twin.dynamics, Bands(twin))

    def start(self, theta: Array) -> None:
        """Begin an episode at theta (n_theta,); ValueError for another shape, or NaN."""
        dynamics = self.dynamics
        first = check_array("theta", theta, (dynamics.problem.n_theta,))
        n = dynamics.problem.model.n_states
        self.alarm = None
        self._first = replace(dynamics, members=dynamics.members[:1])
        self._row = dynamics.row.begin(first)
        self._charts: Array = np.zeros((2, len(CHART_GAINS), n))
        self._steps = 0
        self._stands = np.zeros(n, np.int64)  # samples for which a reading has repeated itself
        self._moved = np.zeros(n)  # how far the twin would have moved it meanwhile

    def watch(self, theta: Array, u: Array, after: Array) -> Alarm | None:
        """Return the episode's first alarm, or None.

        theta and what comes after it (n_theta,) are as read before and after a sample, u (m,) is
        what was commanded. RuntimeError before :meth:`start`.
        """
        if self._row is None:
            raise RuntimeError("No episode has begun: call start(theta) first.")
        if self.alarm is None:
            theta, u, after = (np.array(each, np.float64) for each in (theta, u, after))
            with np.errstate(all="ignore"):
                if (found := self._seen(theta, u, after)) is not None:
                    self.alarm = Alarm(found[0], f"Step {self._steps}: {found[1]}.")
        return self.alarm

    def _seen(self, theta: Array, u: Array, after: Array) -> tuple[str, str] | None:
        """Return what is wrong with a transition: the kind, and what is said."""
        for name, values in (("theta", theta), ("the input", u), ("the reading", after)):
            if not np.isfinite(values).all():
                return "not a number", f"{name} is {values.tolist()}"
        layout = self.dynamics.row
        before = self._row
        if before is None or not np.array_equal(layout.shown(before), theta):
            before = layout.begin(theta)  # it does not follow the last one
        self._row = layout.after(before, u, after)
        predicted = self._first.step(before[None, None], u[None, None])[0, 0]
        innovation = (self._row - predicted)[layout.state]
        self._charts = charted_with(self._charts, innovation, self.bands.doubt(before, u))
        self._steps += 1
        same = self._row[layout.state] == before[layout.state]
        self._stands = (self._stands + 1) * same
        self._moved = (self._moved + innovation) * same
        return self._frozen(self._row[layout.state]) or self._beyond()

    def _frozen(self, reading: Array) -> tuple[str, str] | None:
        """Return an alarm where a reading repeats itself as it would not.

        A noisy sensor does so never, or as the log shows. A settled one may for ever: there the
        twin must say that the state moves.
        """
        stands = self._stands
        bands = self.bands
        noisy = bands.noisy & (stands >= FROZEN * (1 + bands.repeats))
        unsure = np.hypot(bands.error, self._charts[1, 0])  # what is not familiar counts
        # The twin moves by three standard deviations in a sample while a reading stands.
        moving = np.abs(self._moved) > 3.0 * stands * unsure
        problem = self.dynamics.problem
        for i in np.flatnonzero((stands >= FROZEN) & (noisy | moving)):
            name = problem.model.state_names[i] if problem.model.state_names else f"reading {i}"
            text = f"{name} has been {problem.units.to_plant(reading)[i]:.6g} for {stands[i]}"
            return "frozen sensor", f"{text} samples; the twin moves or the sensor is noisy"
        return None

    def _beyond(self) -> tuple[str, str] | None:
        ratios = np.abs(self.bands.ratios(self._charts))
        if not ratios.max() > 1.0:
            return None
        at_once = ratios[:1] if ratios[0].max() > 1.0 else ratios
        gain, i = np.unravel_index(int(np.argmax(at_once)), at_once.shape)
        name = labels_of(self.dynamics.problem.model)[0][int(i)]
        text = f"{name} is off the twin's prediction by {self._charts[0, gain, i]:.3g}"
        if CHART_GAINS[gain] < 1.0:
            text += f" on an average of {1 / CHART_GAINS[gain]:.0f} samples"
        kind = "outside the band" if CHART_GAINS[gain] == 1.0 else "drift"
        return kind, f"{text}, {ratios[gain, i]:.3g} bands"
