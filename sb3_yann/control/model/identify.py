"""Linear models from measured data, with their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, ReadOnlyArrays
from sb3_yann.control.identification.fit import fit_log
from sb3_yann.control.model.linear_model import LinearModel
from sb3_yann.log import Arrays, Log


class OfLog(ReadOnlyArrays):
    """What was fitted to a log: a ``model``, and how well it fits, which may be NaN."""

    model: LinearModel
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def report(self) -> str:
        """Return an account in words, that of the model: poles, controllability, fit and notes."""
        return self.model.report()

    __str__ = report


@dataclass(frozen=True, eq=False)
class Identified(OfLog):
    """A model fitted to data by :func:`identify`, and its uncertainty.

    Attributes
    ----------
    model : LinearModel
        Its notes, and so its report, state the fit in words.
    standard_error_A, standard_error_B, standard_error_E : ndarray, shapes of A, B and E
        Standard errors of the entries, valid for process noise.
    noise_covariance : ndarray, shape (n, n)
        Covariance of the one-step prediction errors.
    degrees_of_freedom : int
        Fitted steps minus the parameters of each row.
    residual_autocorrelation : ndarray, shape (n,)
        One step apart. Far from zero, measurement noise or an unmodeled state spoils the model.
    one_step_fit, ten_step_fit : ndarray, shape (n,)
        ``100 (1 - |x - predicted| / |x - mean|)`` in percent over the held-out data, predicted one
        and ten steps ahead. NaN without such data, or for a constant state.
    excitation : float
        Smallest over largest singular value of the states and inputs, each in units of its spread.
    delays : tuple of int, length m
        Dead time of each input in samples, as ``PastInputs(env, delays)`` takes it.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x, u = np.zeros((201, 1)), rng.normal(size=(200, 1))
    >>> for k in range(200):
    ...     x[k + 1] = 0.8 * x[k] + 0.5 * u[k] + 0.01 * rng.normal()
    >>> found = identify(x, u, dt=1)
    >>> bool(abs(found.model.A - 0.8) < 3 * found.standard_error_A)
    True
    """

    model: LinearModel
    standard_error_A: Array
    standard_error_B: Array
    standard_error_E: Array
    noise_covariance: Array
    degrees_of_freedom: int
    residual_autocorrelation: Array
    one_step_fit: Array
    ten_step_fit: Array
    excitation: float
    delays: tuple[int, ...]


def identify(  # noqa: PLR0913 (what a log may bring along)
    states: Log | Arrays,
    actions: Arrays | None = None,
    *,
    dt: float | None = None,
    disturbances: Arrays | None = None,
    x_ss: ArrayLike | None = None,
    u_ss: ArrayLike | None = None,
    d_ss: ArrayLike | None = None,
    offset: bool = True,
    ridge: float | str = "auto",
    held_out: float = 0.2,
    time: Arrays | None = None,
    delay: int | str | Sequence[int] = 0,
) -> Identified:
    """Fit ``x[k+1] = A x[k] + B u[k] + E d[k] + c`` to measured episodes by least squares.

    The estimate is consistent under process noise, independent from step to step (Ljung, *System
    Identification*, 2nd ed., section 7.3). Sensor noise biases A towards zero: notes say so, of a
    poor model a warning; `identify_outputs` models it.

    Parameters
    ----------
    states : Log, or array_like, shape (T+1, n), or a sequence of such
        A log, which brings all up to ``time``; or one episode or several, each with the state
        before every action and after the last.
    actions : array_like, shape (T, m), or a sequence of such
        The inputs as they were executed (clipped, if the plant clips).
    dt : float
        Sampling time.
    disturbances : array_like, shape (T, d), or a sequence of such, optional
        Measured disturbances, which make E.
    time : array_like, shape (T+1,), or a sequence of such, optional
        When each row was measured, in the unit of ``dt``; steps of another time are left out.
    x_ss, u_ss, d_ss : array_like, shapes (n,), (m,) and (d,), optional
        The operating point. By default, inputs and disturbances take their mean, and the state is
        the fitted model's steady state. An integrating state keeps its mean, which the inputs hold.
    offset : bool, default True
        Fit c too. Without it, c is 0, and the default operating point is zero.
    ridge : float or "auto", default "auto"
        Weight of the squared entries, each in units of the spread of its regressor, relative to one
        step's. It makes poor excitation usable; the standard errors leave out its bias to zero.
        "auto" is 0 for a well excited log. For a weak one, of an excitation below 0.01, free runs
        over held-out data choose.
    held_out : float, default 0.2
        Fraction of all steps, the last ones, that tests the fit instead of making the model.
    delay : int, sequence of int, or "auto", default 0
        Dead time of the inputs, or of each, in samples: so many past inputs become states, newest
        first, input by input. "auto" finds it, up to 10 samples.

    Raises
    ------
    ValueError
        For data in which some combination of states and inputs does not move: the message names it.
        Also for a log so weak that with any ridge free runs tell no more than the mean.

    Examples
    --------
    >>> x, u = np.zeros((101, 1)), np.random.default_rng(0).normal(size=(100, 1))
    >>> for k in range(100):
    ...     x[k + 1] = 0.8 * x[k] + 0.5 * u[k]
    >>> found = identify(x, u, dt=1)
    >>> found.model.A.round(6).tolist(), found.ten_step_fit.round(3).tolist()
    ([[0.8]], [100.0])
    """
    if isinstance(states, Log):
        own = {"actions": actions, "dt": dt, "disturbances": disturbances, "time": time}
        if beside := [name for name, value in own.items() if value is not None]:
            raise TypeError(f"{beside} is given, but the log has its own: leave it out.")
        log = states
    elif actions is None or dt is None:
        raise TypeError("identify takes a Log, or states and actions with dt=.")
    else:
        log = Log.from_arrays(states, actions, dt, disturbances=disturbances, time=time)
    point = {"x_ss": x_ss, "u_ss": u_ss, "d_ss": d_ss}
    try:
        system, step, fits, delays = fit_log(
            log, **point, offset=offset, ridge=ridge, held_out=held_out, delay=delay
        )
    except ValueError as error:
        raise ValueError(log.in_names(str(error))) from None
    model = LinearModel(**{**vars(system), "disturbance_names": log.disturbance_names})
    if log.state_names:
        model = model.named(log.state_names, log.input_names, log.named_units)
    n = model.n_states
    A, B, E = np.split(step.standard_errors, [n, n + model.n_inputs], axis=1)
    residuals = (step.covariance, step.degrees_of_freedom, step.autocorrelation)
    return Identified(model, A, B, E, *residuals, *fits, step.excitation, delays)
