"""Linear models of plants that show outputs rather than states, from their logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from sb3_yann._validation import Array, check_array, check_int, check_range, warn
from sb3_yann.control.gains import CURVED, Gains
from sb3_yann.control.identification.dead_time import (
    as_delays,
    early_note,
    exact_memory,
    longest_note,
    memory_labels,
)
from sb3_yann.control.identification.fit import require_moving, system_of
from sb3_yann.control.identification.innovations import (
    TINY_RIDGE,
    Innovations,
    Past,
    errors_of,
    filtered,
    shifted,
)
from sb3_yann.control.identification.least_squares import WEAK, Regression, pole_note, regress
from sb3_yann.control.identification.outputs import (
    RUN_AHEAD,
    Structure,
    feedback,
    fit_structure,
    predicted,
    stand_ins,
)
from sb3_yann.control.identification.residuals import curvature_test, listed, listed_errors
from sb3_yann.control.linear_system import names
from sb3_yann.control.model.identify import OfLog
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.control.observer import StateEstimator, before_step
from sb3_yann.log import Arrays, Episode, Log


@dataclass(frozen=True, eq=False)
class IdentifiedOutputs(OfLog):
    """A model in innovation form, fitted to outputs by :func:`identify_outputs`.

    In deviations from the operating point, ``x[k+1] = A x[k] + B u[k] + E d[k] + K e[k]`` and
    ``y[k] = C x[k] + e[k]``.

    Attributes
    ----------
    model : LinearModel
        With C. The first states are the outputs where these tell enough apart, in their own units;
        the last ones are inputs on their way.
    gain, noise : ndarray, shapes (n, q) and (q, q)
        The Kalman gain K, one step ahead, and the covariance of e.
    order : int
        Number of states without inputs on their way.
    delays : tuple of int, length m
        Dead time of each input in samples.
    one_step_fit, long_fit : ndarray, shape (q,)
        Fits in percent over held-out data, one and twenty steps ahead.
    excitation : float
        Smallest over largest singular value of outputs and inputs, each in units of its spread.
    start : tuple of ndarray, shapes (n,) and (n, n)
        Mean and covariance of the states in the log, from which a prediction begins.
    every : tuple of int, length q
        Each output is read every so many samples, of those whose inputs are known.
    drift : ndarray, shape (n,)
        Motion in one sample at the operating point, which ``model`` leaves out.

    Examples
    --------
    >>> u = np.random.default_rng(0).normal(size=(200, 1))
    >>> y = np.zeros((201, 1))
    >>> for k in range(200):
    ...     y[k + 1] = 0.8 * y[k] + 0.5 * u[k]
    >>> found = identify_outputs(y, u, dt=1.0)
    >>> found.order, found.predict(y, u, ahead=5).shape
    (1, (196, 1))
    """

    model: LinearModel
    gain: Array
    noise: Array
    order: int
    delays: tuple[int, ...]
    one_step_fit: Array
    long_fit: Array
    excitation: float
    start: tuple[Array, Array]
    drift: Array
    every: tuple[int, ...] = ()

    def predict(
        self,
        outputs: ArrayLike,
        inputs: ArrayLike,
        ahead: int = RUN_AHEAD,
        *,
        disturbances: ArrayLike | None = None,
    ) -> Array:
        """Return the outputs (T + 1 - ahead, q) so many samples ahead of what is known.

        Row k is the output at k + ahead from the outputs up to k and the inputs that were played.

        Parameters
        ----------
        outputs, inputs : array_like, shapes (T + 1, q) and (T, m)
            In plant units. Outputs may be NaN: the filter goes on without them.
        ahead : int, default 20
            Samples, at least 1 and at most T.
        disturbances : array_like, shape (T, d), optional
            As many as the model measures.
        """
        model = self.model
        u = check_array("inputs", inputs, ("T", model.n_inputs))
        y = np.array(outputs, np.float64)
        if y.shape != (len(u) + 1, len(self.noise)):
            wanted = f"({len(u) + 1}, {len(self.noise)}): one row more than inputs"
            raise ValueError(f"outputs has shape {y.shape}, expected {wanted}.")
        d = np.zeros((len(u), 0)) if disturbances is None else disturbances
        d = check_array("disturbances", d, (len(u), model.n_disturbances))
        ahead = check_int("ahead", ahead, 1)
        if ahead > len(u):
            raise ValueError(f"ahead = {ahead}, but the record has {len(u)} steps.")
        driven = np.hstack([model.B, model.E])
        rest = model.x_ss - model.A @ model.x_ss - driven @ np.append(model.u_ss, model.d_ss)
        c = rest + self.drift
        none = np.zeros(len(self.noise))
        sparse = any(each > 1 for each in self.every)
        parts = model.A, driven, self.gain, model.shown, c, none, self.noise
        return predicted(Innovations(*parts, sparse), Episode(y, u, d), self.start, ahead)

    def estimator(self) -> StateEstimator:
        """Return the Kalman filter of this model, in deviations, for `wrappers.EstimateState`."""
        spread = self.gain @ self.noise
        own = len(self.model.A) - sum(self.delays)  # the rest are inputs on their way
        gain = np.zeros_like(self.gain)
        gain[:own] = before_step(self.model.A[:own, :own], self.gain[:own])
        return StateEstimator(
            self.model,
            state_noise=spread @ self.gain.T,
            measurement_noise=self.noise,
            cross_noise=spread,
            every=self.every or 1,
            gain=gain,
        )


def identify_outputs(
    outputs: Log | Arrays,
    inputs: Arrays | None = None,
    dt: float | None = None,
    order: int | str = "auto",
    delay: int | str | Sequence[int] = "auto",
    disturbances: Arrays | None = None,
    *,
    held_out: float = 0.2,
) -> IdentifiedOutputs:
    """Fit a model in innovation form to measured outputs and inputs.

    An ARX model of many lags gives states of each order by balanced reduction (Chiuso, Automatica
    43, 2007), and prediction errors refine it. Records may come from closed loop. An integrator is
    a pole that may lie on the unit circle, or near it.

    Parameters
    ----------
    outputs : Log, or array_like, shape (T + 1, q), or a sequence of such
        A log whose states are the outputs; or one record or several. Rows with NaN are gaps, but
        for outputs that are read in fewer than two of three samples: these need not be there.
    inputs : array_like, shape (T, m), or a sequence of such
        As they were executed: row k acts between rows k and k + 1 of the outputs.
    dt : float
        Sampling time.
    disturbances : array_like, shape (T, d), or a sequence of such, optional
        Measured disturbances, which make E.
    order : int or "auto", default "auto"
        Number of states without dead time. "auto" takes that of the least criterion of Hannan and
        Quinn (J. R. Stat. Soc. B 41, 1979), up to 16.
    delay : int, sequence of int, or "auto", default "auto"
        Dead time of the inputs in samples. "auto" takes one, up to 10, where the latest inputs
        have no effect, it lowers the criterion, and free runs over held-out data do not suffer.
        Outputs that are read at each sample tell; where there is none, it takes 0.
    held_out : float, default 0.2
        Fraction of all steps, the last ones, over which the fits are reported. The model that is
        returned is fitted to all of them.

    Raises
    ------
    ValueError
        For data in which some combination of outputs and inputs does not move, inputs that are a
        function of earlier outputs, or an output that is read too few times: the message names it.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> u, x = rng.normal(size=(400, 1)), np.zeros((401, 2))
    >>> for k in range(400):
    ...     x[k + 1] = [[0.8, 0.3], [-0.3, 0.8]] @ x[k] + [0.0, 1.0] * u[k]
    >>> found = identify_outputs(x[:, :1] + 0.01 * rng.normal(size=(401, 1)), u, dt=1)
    >>> found.order, found.delays, found.predict(x[:, :1], u, ahead=5).shape
    (2, (0,), (396, 1))
    """
    fewest = 30  # readings of an output that is read now and then: a model fits fewer by heart
    if isinstance(outputs, Log):
        given = {"inputs": inputs, "dt": dt, "disturbances": disturbances}
        if beside := [name for name, value in given.items() if value is not None]:
            raise TypeError(f"{beside} is given, but the log has its own: leave it out.")
        log = outputs
    elif inputs is None or dt is None:
        raise TypeError("identify_outputs takes a Log, or outputs and inputs with dt=.")
    else:
        log = Log.with_gaps(outputs, inputs, dt, disturbances)
    wanted = None if isinstance(order, str) and order == "auto" else check_int("order", order, 1)
    (q, m, d) = log.sizes
    read = list(log.episodes)
    for i, each in enumerate(np.concatenate([e.states for e in read]).T):
        count = np.isfinite(each).sum()
        if log.every[i] > 1 and count < fewest:
            words = f"y[{i}] has {count} readings, and fewer than {fewest} tell no dynamics"
            raise ValueError(log.in_names(f"{words}: leave it out, or log for longer."))
    episodes = stand_ins(read)
    try:
        require_moving(episodes)
        plain = regress(episodes)
        center = plain.center
        scale = np.where(plain.spread > 0, plain.spread, 1.0)
        scaled = [_scaled(each, center, scale, q, m) for each in read]
        filled = [_scaled(each, center, scale, q, m) for each in episodes]
        follows = feedback(filled)
        early = early_note(filled, 4)  # earlier outputs beside which inputs of later rows are tried
    except ValueError as error:
        words = str(error).replace("x[", "y[").replace(", or pass ridge > 0", "")
        raise ValueError(log.in_names(words)) from None
    if early:
        warn(early[0])
    share = check_range("held_out", held_out, 0, 0.5, "[]")
    found, search = fit_structure(scaled, wanted, as_delays(delay, m), share)
    values, doubts, integrators, gain_errors = errors_of(found.model, search.chunks)
    model, start = _in_plant_units(found, center, scale, q)
    states = [
        replace(x, states=filtered(model, x.states, x.driven @ model.B.T + model.c, start))
        for x in shifted(read, found.delays)
    ]
    n = model.order
    if wanted is not None and n < wanted:
        warn(f"order = {order}, but the log tells no more than {n} states: these are taken.")
    step = regress(states, ridge=TINY_RIDGE * sum(map(len, states)))
    both = np.hstack([model.A, model.B])
    step = replace(step, coefficients=both, reached=both @ step.center + model.c)
    system = system_of(step, (None, None, None), log.dt, [0] * m)
    drift = step.predict(np.concatenate([system.x_ss, system.u_ss, system.d_ss])[None])[0]
    A, B, E, C, K = _with_memory(model, m, found.delays)
    errors = np.zeros((4, *B.shape))
    own = names((n,))
    if np.array_equal(model.C, np.eye(q, n)):  # the first states are the outputs
        errors[:, :q] = gain_errors[..., :m] * scale[:q, None] / scale[q : q + m]
        own[:q] = log.state_names or own[:q]
    state_names = [*own, *memory_labels(found.delays, log.input_names or names((0, m)))]
    state_names *= bool(log.state_names or any(found.delays))
    told = _notes(log, found, search.past, plain, model, follows, (values, doubts))
    named = *state_names, *log.input_names, *log.disturbance_names
    whole = LinearModel(
        A,
        B,
        log.dt,
        np.append(system.x_ss, np.repeat(system.u_ss, found.delays)),
        system.u_ss,
        E if d else None,
        system.d_ss if d else None,
        notes=[*system.notes, *early, *told],
        gains=Gains.of(A, B, integrators, errors),
        state_names=state_names,
        input_names=log.input_names,
        disturbance_names=log.disturbance_names,
        units={name: unit for name, unit in log.named_units.items() if name in named},
        C=C,
        time_unit=log.time_unit,
    )
    late = q + np.repeat(np.arange(m), found.delays)
    memory = np.diag(plain.spread[late] ** 2)
    return IdentifiedOutputs(
        model=whole,
        gain=K,
        noise=model.noise,
        order=found.model.order,
        delays=found.delays,
        one_step_fit=found.fits[0],
        long_fit=found.fits[1],
        excitation=plain.excitation,
        start=(np.append(start[0], plain.center[late]), linalg.block_diag(start[1], memory)),
        every=log.every,
        drift=np.append(drift - system.x_ss, np.zeros(len(late))),
    )


def _scaled(each: Episode, center: Array, scale: Array, q: int, m: int) -> Episode:
    driven = (each.driven - center[q:]) / scale[q:]
    return Episode((each.states - center[:q]) / scale[:q], driven[:, :m], driven[:, m:])


def _in_plant_units(
    found: Structure, center: Array, scale: Array, q: int
) -> tuple[Innovations, tuple[Array, Array]]:
    """Return the model of inputs and outputs in plant units, and its first states.

    The first states are the outputs, where C can be inverted for that. Outputs count from zero:
    ``y = C x + e``.
    """
    model = found.model
    n = found.model.order
    unit = scale[:q]
    driven = scale[q:]
    C = unit[:, None] * model.C
    rest = center[:q] + unit * model.y_0
    sizes = np.linalg.svd(model.C, compute_uv=False)
    T = np.eye(n)
    # 1e3: condition number of C up to which outputs serve as states
    if n >= q and sizes[-1] * 1e3 > sizes[0]:
        T = np.vstack([C, linalg.null_space(model.C).T])
        C = np.eye(q, n)
    back = np.linalg.inv(T)
    shift = np.linalg.lstsq(C, rest, rcond=None)[0]
    A = T @ model.A @ back
    B = T @ model.B / driven
    K = T @ model.K / unit
    c = T @ model.c + shift - A @ shift - B @ center[q:]
    mean = T @ found.start[0] + shift
    spread = T @ found.start[1] @ T.T
    left = rest - C @ shift
    if np.any(np.abs(left) > 1e-9 * (np.abs(rest) + unit)):
        # Fewer states than outputs: a state that is always 1 holds what C x leaves of the outputs.
        A = linalg.block_diag(A, 0.0)
        B = np.vstack([B, np.zeros((1, B.shape[1]))])
        K = np.vstack([K, np.zeros((1, q))])
        C = np.column_stack([C, left])
        c = np.append(c, 1.0)
        mean = np.append(mean, 1.0)
        spread = linalg.block_diag(spread, 0.0)
    noise = unit[:, None] * model.noise * unit
    return Innovations(A, B, K, C, c, np.zeros(q), noise, model.sparse), (mean, spread)


def _with_memory(
    model: Innovations, m: int, delays: Sequence[int]
) -> tuple[Array, Array, Array, Array, Array]:
    """Return A, B, E, C and K with the inputs on their way as the last states."""
    n = model.order
    late = sum(delays)
    A: Array = linalg.block_diag(model.A, np.zeros((late, late)))
    B, E = np.split(np.pad(model.B, [(0, late), (0, 0)]), [m], axis=1)
    waits = np.array(delays) > 0
    A[:n, (n - 1 + np.cumsum(delays))[waits]] = model.B[:, :m][:, waits]
    B[:, waits] = 0.0
    A, B = exact_memory(A, B, delays, n)
    C = np.pad(model.C, [(0, 0), (0, late)])
    return A, B, E, C, np.pad(model.K, [(0, late), (0, 0)])


def _notes(
    log: Log,
    found: Structure,
    past: Past,
    plain: Regression,
    model: Innovations,
    follows: list[tuple[int, float]],
    poles: tuple[Array, Array],
) -> list[str]:
    """Return notes on the fit, dead time, weak excitation, feedback, curvature and poles."""
    driven = names((0, *log.sizes[1:]))
    notes = [
        f"From outputs: order {found.model.order}, fitted to {sum(map(len, log.episodes))} steps; "
        f"one step differs from the prediction by {listed_errors(model.noise, plain.spread)} "
        "(standard deviation of each output). A policy sees estimates: "
        "sb3_yann.wrappers.EstimateState(env, found.estimator())."
    ]
    if not np.all(np.isnan(found.fits[0])):
        longer = f", {listed(found.fits[1])} % {RUN_AHEAD} steps ahead"
        notes.append(
            f"Fit over data held out, 100 % is perfect: {listed(found.fits[0])} % one step ahead"
            f"{longer * bool(np.any(np.isfinite(found.fits[1])))}."
        )
    if any(found.delays):
        notes.append(
            f"Dead time: inputs act for {[*found.delays]} samples. The states from "
            f"x[{model.order}] on are the inputs on their way.{longest_note(found.delays)}"
        )
    if plain.excitation < WEAK:
        notes.append(
            f"Weakly excited: {plain.weakest.replace('x[', 'y[')} moved {plain.excitation:.1e} "
            "times as much as the most excited combination. Entries along it are uncertain."
        )
    notes += [
        f"{driven[j]} has no effect on the outputs beyond chance. Is it delayed by more "
        "than the log shows, too small beside the noise, or not what the plant got?"
        for j in past.idle()
    ]
    notes += [
        f"{driven[j]} follows the outputs: a feedback law explains all but {100 * left:.2g} % of "
        "what its own past leaves. Its gain rests on that rest."
        for j, left in follows
    ]
    curvature = curvature_test(past.arx, past.rows)[0]
    if np.any(curvature > 0):
        notes.append(
            f"{CURVED}squares and products of outputs and inputs explain "
            f"{listed(100 * curvature)} % of the prediction errors' variance. The plant is "
            "not linear over this log: record closer to the operating point."
        )
    if log.lost_steps:
        notes.append(f"{log.lost_steps} steps at gaps, or of another time than dt, are left out.")
    notes = [log.in_names(each) for each in notes]
    notes.append(pole_note(*poles, "process and sensor noise"))
    shown = log.state_names or [f"y[{i}]" for i in range(len(log.every))]
    if rare := [f"{name} every {n}" for name, n in zip(shown, log.every, strict=True) if n > 1]:
        notes.append(f"Read now and then: {', '.join(rare)} samples.")
    return notes
