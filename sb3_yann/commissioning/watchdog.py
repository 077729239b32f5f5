"""A watchdog: tells within an episode that the plant is no longer what its twin describes."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from sb3_yann._validation import Array, check_array
from sb3_yann.commissioning.control_limits import GAINS, Act, ControlLimits, EwmaCharts
from sb3_yann.control.model.labels import name_of
from sb3_yann.twin.dynamics import Dynamics
from sb3_yann.twin.plant_twin import PlantTwin

FROZEN = 3
"""Repeats of a reading from which on it may be frozen."""
MOVED = 3.0
"""Standard deviations that the twin's prediction moves in a sample while a reading stands."""
WINDOW = 60
"""Transitions in which an actuator may have stuck."""
SHARE, UNEXPLAINED, CERTAIN = 0.2, 0.1, 5.0
"""A stuck input: how near to one its share is, what it leaves of the squared errors, certainty."""


@dataclass(frozen=True)
class Alarm:
    """Why the plant should go back to its MPC.

    Attributes
    ----------
    kind : str
        "not a number", "violation", "outside the band", "drift", "frozen sensor", "actuator" or
        "cost".
    message : str
        What was seen, for people.

    Examples
    --------
    >>> Alarm("violation", "The plant reports a violation.").kind
    'violation'
    """

    kind: str
    message: str


@dataclass(eq=False, repr=False)
class Watchdog:
    """Compares each transition of the plant with what its twin predicts.

    Innovations are charted at several gains: at once for what is abrupt, averaged over up to 50
    samples for what is small and lasts. Their bands come from episodes of the log that the fit
    has not seen, times a factor. They widen where the log tells little. A run of the twin under
    the policy bounds the cost. A reading that repeats itself while the twin moves is frozen.

    Make one with :meth:`of`, anew after each fit of the twin. It holds nothing from one episode
    to the next, and pickles.

    Attributes
    ----------
    dynamics : Dynamics
        The twin's members.
    bands : ControlLimits
        How far all may go while all is well.
    alarm : Alarm or None
        The first one of this episode.

    Examples
    --------
    >>> import gymnasium
    >>> from sb3_yann import PlantTwin
    >>> from sb3_yann.evaluation import evaluate
    >>> law = (problem := gymnasium.make("CSTR-v0").observation_space.problem).explicit()
    >>> log = evaluate(law, "CSTR-v0", seeds=range(6))
    >>> x, u = log.observations[5], log.actions[5]
    >>> twin = PlantTwin.fit(problem, [*zip(log.observations[:5], log.actions)])
    >>> dog = Watchdog.of(twin)
    >>> dog.start(x[0], law)
    >>> any(dog.watch(x[k], u[k], x[k + 1]) for k in range(200))
    False
    >>> dog.watch(x[200], u[200], x[201] + [0, 0, 0, 5]).kind
    'outside the band'
    """

    dynamics: Dynamics
    bands: ControlLimits
    alarm: Alarm | None = None
    _episode: _Episode | None = field(default=None, init=False)

    @classmethod
    def of(cls, twin: PlantTwin) -> Watchdog:
        """Return the watchdog of a twin, calibrated on its log.

        Raises
        ------
        TypeError
            If it is no PlantTwin.
        ValueError
            If its log is a single episode.
        """
        if not isinstance(twin, PlantTwin):
            raise TypeError(f"twin = {twin!r} must be a PlantTwin.")
        return cls(twin.dynamics, ControlLimits.of(twin))

    def __repr__(self) -> str:
        """Say whether it is quiet."""
        return f"Watchdog({'quiet' if self.alarm is None else self.alarm})"

    def __getstate__(self) -> dict[str, object]:
        """Leave out the running episode: its policy need not pickle."""
        return {"dynamics": self.dynamics, "bands": self.bands, "alarm": self.alarm}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state, _episode=None)

    @property
    def quiet(self) -> bool:
        """Whether there has been no alarm in this episode."""
        return self.alarm is None

    def start(self, theta: Array, act: Act) -> None:
        """Begin an episode.

        Parameters
        ----------
        theta : ndarray, shape (n_theta,)
            The first one.
        act : callable
            The policy that will act, from theta (rows, n_theta) to inputs (rows, m).

        Raises
        ------
        ValueError
            If theta has another shape, or is not finite.
        """
        problem = self.dynamics.problem
        first = check_array("theta", theta, (problem.n_theta,))
        first = self.dynamics.row.begin(first)
        tracks = EwmaCharts(self.dynamics, self.bands.predictive_variance, first, act)
        self.alarm, self._episode = None, _Episode(tracks, first)

    def watch(self, theta: Array, u: Array, after: Array, violation: bool = False) -> Alarm | None:
        """Return an alarm, or None: after one the episode's alarm stays as it is.

        Parameters
        ----------
        theta, after : ndarray, shape (n_theta,)
            Before and after a sample, as read.
        u : ndarray, shape (m,)
            What was commanded.
        violation : bool, default False
            Whether the plant reports one.

        Raises
        ------
        RuntimeError
            Before :meth:`start`.
        """
        if self._episode is None:
            raise RuntimeError("No episode has begun: call start(theta, act) first.")
        if self.alarm is None:
            theta, u, after = (np.array(each, np.float64) for each in (theta, u, after))
            with np.errstate(all="ignore"):
                self.alarm = self._seen(self._episode, theta, u, after, violation)
        return self.alarm

    def _seen(
        self, episode: _Episode, theta: Array, u: Array, after: Array, violation: bool
    ) -> Alarm | None:
        """Return what is wrong with a transition."""
        for name, values in (("theta", theta), ("the input", u), ("the reading", after)):
            if not np.isfinite(values).all():
                return episode.alarm("not a number", f"{name} is {np.asarray(values).tolist()}")
        if violation:
            return episode.alarm("violation", "the plant reports a violation")
        episode.take(theta, u, after)
        return self._frozen(episode) or self._beyond(episode) or self._dear(episode)

    def _frozen(self, episode: _Episode) -> Alarm | None:
        """Return an alarm where a reading repeats itself as it would not.

        A noisy sensor does so never, or as the log shows. A settled one may for ever: there the
        twin must say that the state moves.
        """
        stands, bands = episode.stands, self.bands
        if stands.max() < FROZEN:
            return None
        noisy = bands.noisy & (stands >= FROZEN * (1 + bands.repeats))
        unsure = np.hypot(bands.error, episode.tracks.doubts[0])  # what is not familiar counts
        moving = np.abs(episode.moved) > MOVED * stands * unsure
        for i in np.flatnonzero((stands >= FROZEN) & (noisy | moving)):
            problem = self.dynamics.problem
            name = problem.model.state_names
            shown = problem.units.to_plant(episode.reading)[i]
            said = f"{name[i] if name else f'reading {i}'} has been {shown:.6g}"
            said += f" for {stands[i]} samples"
            return episode.alarm("frozen sensor", f"{said}; the twin moves or the sensor is noisy")
        return None

    def _beyond(self, episode: _Episode) -> Alarm | None:
        """Return an alarm where a chart leaves its band."""
        ratios = np.abs(self.bands.ratios(episode.tracks))
        if not ratios.max() > 1.0:
            return None
        gain, i = np.unravel_index(int(np.argmax(ratios)), ratios.shape)
        mean, times = episode.tracks.charts[gain, i], ratios[gain, i]
        model = self.dynamics.problem.model
        said = f"{name_of(model, 'state', int(i))} is off the twin's prediction by {mean:.3g}"
        if GAINS[gain] < 1.0:
            said += f" on an average of {1 / GAINS[gain]:.0f} samples"
        said += f", {times:.3g} bands"
        stuck = self._stuck(episode)
        if stuck is not None:
            j, value = stuck
            value += self.dynamics.problem.units.u_ss[j]
            return episode.alarm(
                "actuator", f"{said}: as if {name_of(model, 'input', j)} stuck at {value:.4g}"
            )
        return episode.alarm("outside the band" if GAINS[gain] == 1.0 else "drift", said)

    def _dear(self, episode: _Episode) -> Alarm | None:
        """Return an alarm where the episode costs more than the twin's."""
        ratio, tracks = self.bands.cost_ratio(episode.tracks), episode.tracks
        if not ratio > 1.0:
            return None
        expected = f"{tracks.costs.mean():.4g} in the twin ({ratio:.3g} bands)"
        return episode.alarm("cost", f"the cost so far is {tracks.cost:.4g}, {expected}")

    def _stuck(self, episode: _Episode) -> tuple[int, float] | None:
        """Return an input, and its value, with which alone the last transitions agree.

        The errors are regressed on what the twin does with an input that stuck at an earlier
        value: one means that it did.
        """
        theta, u, after = (np.array(each) for each in zip(*episode.last, strict=True))
        dynamics, x = self.dynamics, self.dynamics.row.state
        first = Dynamics(dynamics.problem, dynamics.coordinates, dynamics.members[:1])
        predicted = first.step(theta[None], u[None])[0]
        errors = (after - predicted)[:, x] / self.bands.error
        best, found = 0.0, None
        for j in range(u.shape[1]):
            for since in range(len(u) - FROZEN):
                held = u[since:].copy()
                held[:, j] = u[since, j]
                moved = first.step(theta[None, since:], held[None])[0] - predicted[since:]
                effect, error = moved[:, x] / self.bands.error, errors[since:]
                total = float(np.sum(effect**2))
                share = float(np.sum(effect * error)) / max(total, 1e-300)
                left = float(np.sum((error - effect) ** 2)) - error.size
                agrees = abs(share - 1) < SHARE and left < UNEXPLAINED * float(np.sum(error**2))
                if agrees and share * np.sqrt(total) > max(CERTAIN, best):
                    best, found = share * np.sqrt(total), (j, float(u[since, j]))
        return found


class _Episode:
    """What is remembered within an episode."""

    def __init__(self, tracks: EwmaCharts, row: Array) -> None:
        self.tracks, self.row, n = tracks, row, tracks.dynamics.problem.model.n_states
        self.stands, self.moved = np.zeros(n, np.int64), np.zeros(n)
        self.last: deque[tuple[Array, Array, Array]] = deque(maxlen=WINDOW)

    def take(self, theta: Array, u: Array, after: Array) -> None:
        """Take in a transition, of which all is finite."""
        layout = self.tracks.dynamics.row
        if not np.array_equal(layout.shown(self.row), theta):  # one that does not follow the last
            self.row = layout.begin(theta)
        before, self.row = self.row, layout.after(self.row, u, after)
        self.last.append((before, u, self.row))
        self.tracks.step(before, u, self.row)
        same = self.reading == before[layout.state]
        self.stands = (self.stands + 1) * same
        self.moved = (self.moved + self.tracks.innovation) * same

    @property
    def reading(self) -> Array:
        """The plant's state (n,) as it was measured last."""
        return self.row[self.tracks.dynamics.row.state]

    def alarm(self, kind: str, said: str) -> Alarm:
        """Return an alarm that names the step."""
        return Alarm(kind, f"Step {self.tracks.steps}: {said}.")
