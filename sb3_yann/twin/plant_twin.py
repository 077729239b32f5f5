"""A plant's twin: its linear model, and what its own episodes teach beyond it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from sb3_yann._progress import shown
from sb3_yann._validation import Array, check_bool, check_int, check_type, warn
from sb3_yann.control import LinearMPC, StateEstimator
from sb3_yann.control.identification.residuals import FOLDS
from sb3_yann.control.linear_system import labels_of
from sb3_yann.log import SECONDS, Log
from sb3_yann.twin.dynamics import Coordinates, Dynamics, Residual
from sb3_yann.twin.env import LearntModel, TwinEnv
from sb3_yann.twin.forecast import Forecast, Judge, forecast
from sb3_yann.twin.hidden import GUESS, shoot
from sb3_yann.twin.log import (
    Episode,
    as_episodes,
    as_pairs,
    fingerprint,
    pieces,
    warn_of_estimates,
    without_copies,
    without_short_pieces,
)
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.twin.selection import (
    KINDS,
    Candidate,
    Setting,
    candidates,
    fit_ensemble,
    held_out,
    judges,
    reidentified,
    ridge,
    without_each_fold,
)
from sb3_yann.twin.trust import (
    ALONE,
    Trust,
    UntrustedTwinError,
    costs_of_each,
    evidence,
    relative_error,
    report,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HIDDEN_SETTINGS = Setting(1, 1e-4, 1.0), Setting(2, 1e-4, 1.0), Setting(2, 1e-6, 1.0)
"""How the residuals of states that nothing shows are fitted, the least free first."""
LONG_LOG = 100  # steps of a log that networks are tried on


@dataclass(frozen=True, eq=False, repr=False)
class PlantTwin(LearntModel):
    """A simulator learnt from a plant's own episodes, which says what it is worth.

    ``x+ = A x + B u + E d + residual(x, d, u)``. The residual is none, a polynomial that is shrunk
    towards the given model, or small networks, by free runs over episodes that its fit has not
    seen. Several members, fitted to episodes drawn with replacement, tell how much is not known.
    Outside the data the residual stays what it is at their edge. Where an observer *estimates* d,
    it is a part of the twin. Make one with :meth:`fit`.

    Attributes
    ----------
    problem : LinearMPC
    episodes : tuple of Episode
        The log, in rows of ``dynamics.row``: theta, and what an observer remembers.
    kind : str
        The residual that was chosen.
    dynamics : Dynamics
        The members; the first one is fitted to all episodes.
    trust : Trust
        The evidence.
    notes : tuple of str
        The log's fingerprint, and what of it was left out.
    judges : tuple of Judge
        Twins that the log does not refute, each fitted without every fold of the episodes.

    Examples
    --------
    >>> import gymnasium
    >>> from sb3_yann.evaluation import evaluate
    >>> problem = gymnasium.make("CSTR-v0").observation_space.problem
    >>> log = evaluate(problem.explicit(), "CSTR-v0", seeds=range(5))
    >>> twin = PlantTwin.fit(problem, [*zip(log.observations, log.actions)])
    >>> twin.trusted
    True
    >>> twin.env().reset(seed=0)[0].shape
    (4,)
    >>> today = evaluate(twin.reidentified().explicit(), "CSTR-v0", seeds=range(5))
    >>> bool(today.costs.mean() < log.costs.mean())
    True
    """

    kind: str
    trust: Trust
    notes: tuple[str, ...] = ()
    judges: tuple[Judge, ...] = ()

    def __repr__(self) -> str:
        """Name the sizes, and whether to trust it."""
        sizes = f"{len(self.episodes)} episodes, {len(self.dynamics.members)} members"
        return f"PlantTwin({self.kind}, {sizes}, {'' if self.trusted else 'not '}trusted)"

    @classmethod
    def fit(  # noqa: PLR0913 (what a log consists of, by name)
        cls,
        problem: LinearMPC,
        episodes: Iterable[tuple[ArrayLike, ArrayLike]],
        *,
        references: Sequence[ArrayLike] | None = None,
        disturbances: Sequence[ArrayLike] | None = None,
        observer: StateEstimator | None = None,
        residuals: Sequence[str] = KINDS,
        n_members: int = 5,
        updates: int = 3000,
        seed: int = 0,
        units_confirmed: bool = False,
        progress_bar: bool = True,
    ) -> PlantTwin:
        """Return the twin of a plant that was logged.

        Parameters
        ----------
        problem : LinearMPC
            The MPC of the plant: its model is where the twin starts from.
        episodes : sequence of pairs, or Log
            States (T + 1, n), or all of theta (T + 1, n_theta), and actions (T, m), in plant units
            where the problem's model has an operating point. A log may hold references and
            disturbances.
        references, disturbances : sequence of array_like, optional
            What theta holds besides the state, shapes (T + 1, p) and (T + 1, d) for each episode.
        observer : StateEstimator, optional
            The one whose estimates x and d of theta are: that of :class:`EstimateState`. States
            that are not all of theta are what it measured, (T + 1, q), and it is run over them:
            a log of outputs is enough. ``disturbances`` are then the measured ones.
        residuals : sequence, default ("none", "linear", "quadratic", "network")
            The candidates. Networks are tried where nothing else predicts well.
        n_members : int, default 5
            The first is fitted to all episodes, the others to as many drawn from them.
        updates : int, default 3000
            Of networks: a twentieth are iterations on single steps, a tenth on windows.
        seed : int, default 0
            Of the draws of episodes, and of the weights that networks start from.
        units_confirmed : bool, default False
            Whether somebody has checked the log's units. A plant whose gain is below 0.6 or above
            1.7 times the model's, or a controller that is a multiple of the law, looks like another
            unit or zero: such a log is not trusted unless you say so. A header with another unit
            than the model's is an error. Inputs of the MPC's own are proven: nothing needs saying.
        progress_bar : bool, default True
            Whether to show what takes more than three seconds.

        Raises
        ------
        TypeError, ValueError
            For a log that cannot be read; one that says little makes a twin that is not trusted.
        """
        check_type("problem", problem, LinearMPC, "a LinearMPC")
        check_int("n_members", n_members)
        check_int("seed", seed, 0)
        check_bool("units_confirmed", units_confirmed)
        check_int("updates", updates)
        if isinstance(residuals, str) or not residuals or not {*residuals} <= {*KINDS}:
            raise ValueError(f"residuals = {residuals!r} must be a list of some of {KINDS}.")
        notes: tuple[str, ...] = ()
        if isinstance(episodes, Log):
            _require_same_sampling(episodes, problem)
            if observer is None and not units_confirmed:
                _require_same_units(episodes, problem)
            whole = episodes if observer is not None else episodes.with_all_states()
            if references is disturbances is None:  # else they are one for each
                whole, notes = without_short_pieces(whole)
                held = [(each.references, each.disturbances) for each in whole.episodes]
                counts = problem.layout.n_references, problem.layout.n_disturbances
                if held[0][0].size and not counts[0]:
                    warn(
                        "The log has set-points and the problem has none: they are ignored. An MPC "
                        "that follows them has tracking=Tracking([...], low, high)."
                    )
                references, disturbances = (
                    [np.vstack([each, each[-1:]]) for each in of] if of[0].size and n else None
                    for of, n in zip(zip(*held, strict=True), counts, strict=True)
                )
            episodes = whole
        row = RowLayout(problem, observer)
        episodes = given = as_pairs(episodes)
        if observer is not None:
            episodes, disturbances = row.estimated(episodes, disturbances)
        log = as_episodes(problem, episodes, references, disturbances)
        log, copied = without_copies(log)
        notes = (fingerprint(given), *notes, *copied)
        if observer is None:
            warn_of_estimates(problem, log)
        log = tuple(Episode(*row.recovered(each.thetas, each.actions)) for each in log)
        settings = residuals, n_members, updates, seed, units_confirmed, notes
        with shown(progress_bar), threadpool_limits(1):
            found = _fitted(row, log, *settings)
            hidden = RowLayout(problem, observer, hidden=True)
            if found.trust.lacks_alone and row.observer is None and hidden.observer is not None:
                log = tuple(Episode(*hidden.recovered(each.thetas, each.actions)) for each in log)
                other = _fitted(hidden, log, *settings)
                found = other if other.trusted else found
        return found

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against the twin; :meth:`report` says why or why not."""
        return self.trust.trusted

    def require_trust(self) -> None:
        """Raise UntrustedTwinError, with its reasons, unless the twin is trusted."""
        if not self.trusted:
            message = " ".join([*self.trust.problems, *self.trust.advice])
            message += " Until then the MPC stays: export(mpc, path) writes it."
            raise UntrustedTwinError(f"The twin is not to be trusted: {message}")

    def report(self) -> str:
        """Return what the twin explains, what it does not know, and whether to trust it."""
        known = [
            f"With {e.says} steps are explained better; a load or noise may look alike."
            for e in self.judges
            if e.actuator.size
        ]
        found = report(self.problem, self.episodes, self.kind, self.trust)
        return "\n".join([*self.notes, found, *known])

    def plot(self, axes: tuple[Axes, Axes] | None = None) -> tuple[Axes, Axes]:
        """Draw costs of held-out episodes, and errors of free runs; return both axes."""
        from sb3_yann.evaluation import plots

        return plots.plot_twin(self.trust, axes)

    def reidentified(self) -> LinearMPC:
        """Return the MPC of the same costs, bounds and horizon with a model of the log.

        Its A, B and E are fitted to the log, and shrunk towards the given ones as far as held-out
        free runs ask for it. It is :attr:`problem` itself where no linear model predicts better.
        With references or disturbances its operating point is where the plant rests today. The
        terminal cost is solved anew, and a terminal set is the new model's invariant one.

        Raises
        ------
        UntrustedTwinError
            If the twin is not to be trusted.
        ValueError
            Where the new model has no steady state or no Riccati solution.
        """
        self.require_trust()
        return reidentified(self.problem, self.dynamics.coordinates, self.episodes)

    def forecast(self, act: Callable[[Array], Array]) -> Forecast:
        """Return what a policy changes on the plant, with an interval over all unrefuted twins.

        Parameters
        ----------
        act : callable
            From theta (rows, n_theta) to inputs (rows, m), in deviations.
        """
        if not self.judges:  # of one episode
            self.require_trust()
        share = np.where(self.trust.moves > 0, self.trust.excitation, np.inf)
        loosest = labels_of(self.problem.model)[1][int(np.argmin(share))]
        found = forecast(self.judges, self.episodes, self.starts, act, loosest)
        if np.min(share) < ALONE and "held steps" not in found.cure:  # more of the same is no help
            cure = f"log held steps of {loosest}: its gain rests on the given B"
            found = found._replace(cure=cure)
        return found

    def env(self) -> TwinEnv:
        """Return a Gymnasium env with the twin's dynamics and the plant's spaces.

        Raises
        ------
        UntrustedTwinError
            If the twin is not to be trusted.
        """
        self.require_trust()
        return TwinEnv(self)


def _fitted(
    row: RowLayout,
    log: tuple[Episode, ...],
    residuals: Sequence[str],
    n_members: int,
    updates: int,
    seed: int,
    units_confirmed: bool,
    notes: tuple[str, ...],
) -> PlantTwin:
    """Return the twin of a log in rows, whose own states are to be found where they are hidden."""
    problem = row.problem
    coordinates = Coordinates.of(row, log)
    if row.hidden:
        log = tuple(shoot(coordinates, log, HIDDEN_SETTINGS[-1], GUESS)[1])
        box = Coordinates.of(row, log)
        coordinates = replace(coordinates, low=box.low, high=box.high, units=box.units)
    parts = pieces(log, FOLDS)
    # 40: pieces of a log of few episodes that its members are fitted to some of
    blocks = log if len(log) >= FOLDS else pieces(log, 40)
    draws = np.random.default_rng(seed).integers(len(blocks), size=(n_members - 1, len(blocks)))
    drawn = [blocks, *([blocks[i] for i in each] for each in draws)]
    kept = without_each_fold(parts)
    # The model as it is comes first, to compare with, whether it may be chosen or not.
    choices = candidates(coordinates, parts, residuals if not row.hidden else ())
    if row.hidden:
        for each in HIDDEN_SETTINGS:
            if KINDS[each.degree] in residuals:
                by_fold = tuple(shoot(coordinates, fold, each)[0] for fold in kept)
                choices.append(Candidate(str(each), by_fold, each))
    first = int("none" not in residuals)
    alone = first == len(choices)
    runs = held_out(coordinates, parts, choices)
    chosen = runs.choose(first) if len(parts) > 1 and not alone else 0
    known = costs_of_each(coordinates, parts, choices[chosen].by_fold)
    long = sum(map(len, parts)) >= LONG_LOG and len(parts) > 1 and not row.hidden
    members: list[Residual] = []
    # 0.01: error of predicted costs, relative to their mean, from which networks are tried
    if "network" in residuals and (alone or (long and not relative_error(*known) <= 0.01)):
        ahead = 20  # steps of the windows that networks are fitted to
        networks = fit_ensemble(coordinates, [*kept, *drawn], seed, ahead=ahead, updates=updates)
        choices.append(Candidate("network", tuple(networks[: len(kept)])))
        runs = held_out(coordinates, parts, choices)
        chosen = runs.choose(first) if len(parts) > 1 else first
        members = networks[len(kept) :]
        known = costs_of_each(coordinates, parts, choices[chosen].by_fold)
    choice = choices[chosen]
    if choice.setting is not None and row.hidden:
        members = [shoot(coordinates, each, choice.setting)[0] for each in drawn]
    elif choice.setting is not None:
        members = [ridge(coordinates, each, [choice.setting])[0] for each in drawn]
    elif choice.name == "none":
        members = [Residual.zero(len(coordinates.scale), problem.model.n_states)] * n_members
    dynamics = Dynamics(problem, coordinates, tuple(members))
    trust = evidence(dynamics, parts, (runs, chosen, known), units_confirmed)
    found = judges(coordinates, log, choice, runs.scores[chosen]) if choice.by_fold else ()
    name = f"hidden states, {choice.name}" if row.hidden else choice.name
    return PlantTwin(problem, log, dynamics, name, trust, notes, found)


def _require_same_sampling(log: Log, problem: LinearMPC) -> None:
    """Raise where a log has another sampling time than the model: a twin steps as its MPC does."""
    model = problem.model
    units = [SECONDS.get(each.time_unit, 0) for each in (log, model)]
    its, own = (log.dt, model.dt) if 0 in units else (log.dt * units[0], model.dt * units[1])
    if abs(its - own) > 0.01 * own:
        raise ValueError(
            f"The log is sampled every {log.dt:g} {log.time_unit}".rstrip()
            + f", the model of the MPC every {model.step_length}. Identify the model at the log's "
            "sampling time, or, where only the unit differs, name it: time_unit= of both."
        )


def _require_same_units(log: Log, problem: LinearMPC) -> None:
    """Raise where a header declares another unit than the model does."""
    model = problem.model
    states, inputs = labels_of(model)
    units = dict(zip([*states, *inputs, *model.disturbance_labels], model.units, strict=False))
    for name, its in log.named_units.items():
        own = units.get(name)
        if its and own and its != own:
            raise ValueError(
                f"{name} is in {its} in the log, and in {own} in the model of the MPC. Log it in "
                f"{own}, or state the MPC in {its}. If only the spelling differs: "
                "PlantTwin.fit(..., units_confirmed=True)."
            )
