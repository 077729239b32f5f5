"""Linear models from measured data, with their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from sb3_yann._validation import Array, ReadOnlyArrays, as_between, as_choice
from sb3_yann.control.identification.fit import fit_log
from sb3_yann.control.model.linear_model import LinearModel


@dataclass(frozen=True, eq=False)
class Identified(ReadOnlyArrays):
    """A model fitted to data, with what the data say of it.

    Attributes
    ----------
    model : LinearModel
        Its notes, and so its report, state the fit in words.
    standard_error_A, standard_error_B, standard_error_E : ndarray, shapes of A, B and E
        Standard errors of the entries, for process noise (see :func:`identify`).
    noise_covariance : ndarray, shape (n, n)
        Covariance of what one step differs from the prediction by.
    degrees_of_freedom : int
        Steps fitted minus parameters of each row.
    residual_autocorrelation : ndarray, shape (n,)
        Of each state's residuals, one step apart. Far from zero, there is measurement noise or an
        unmodeled state, and neither the matrices nor the standard errors hold.
    one_step_fit, ten_step_fit : ndarray, shape (n,)
        ``100 (1 - |x - predicted| / |x - mean|)`` in percent for each state over the data that
        were held out, predicted one step ahead, and ten with the inputs as measured. 100 is
        perfect, 0 no better than the mean. NaN without such data, or of a state that never moves.
    excitation : float
        The least that any combination of states and inputs moved, each in units of its own
        spread, relative to the most. Below 1e-6 the data are refused.
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

    def interval(self, name: str, level: float = 0.95) -> tuple[Array, Array]:
        """Return the lower and upper ends of each entry's confidence interval.

        Parameters
        ----------
        name : {"A", "B", "E"}
            Which matrix.
        level : float, default 0.95
            Probability with which a true entry lies inside: each for itself, Student's t.

        Raises
        ------
        ValueError
            For another name, or a level outside (0, 1).
        """
        name = as_choice("name", name, ("A", "B", "E"))
        level = as_between("level", level, 0, 1, "()")
        value, error = getattr(self.model, name), getattr(self, f"standard_error_{name}")
        width = stdtrit(self.degrees_of_freedom, (1 + level) / 2) * error
        return value - width, value + width


def identify(  # noqa: PLR0913 - the columns of a log, and how to fit them
    states: ArrayLike | Sequence[ArrayLike],
    actions: ArrayLike | Sequence[ArrayLike],
    *,
    dt: float,
    disturbances: ArrayLike | Sequence[ArrayLike] | None = None,
    x_ss: ArrayLike | None = None,
    u_ss: ArrayLike | None = None,
    d_ss: ArrayLike | None = None,
    offset: bool = True,
    ridge: float = 0.0,
    held_out: float = 0.2,
    time: ArrayLike | Sequence[ArrayLike] | None = None,
) -> Identified:
    r"""Fit ``x[k+1] = A x[k] + B u[k] + E d[k] + c`` to measured episodes by least squares.

    The estimate is consistent, and its standard errors hold in long records, where what disturbs
    the plant is *process noise*: independent from step to step and acting on the state itself
    (Ljung, *System Identification*, 2nd ed., section 7.3 and appendix II). Noise of the *sensors*
    stands on both sides of the equation and biases A towards zero (errors in variables), the same
    however long the record is, while the standard errors shrink and know nothing of it. Measured
    on a plant with the poles .9 and .7: noise of 2 % of each state's spread lowers both by .0004,
    of 10 % by .009. After 400 steps that is within the standard errors; after 4,000, at 10 %, no
    95 % interval holds the pole. It shows in the residuals, which then alternate, and the notes of
    the model say so.

    Parameters
    ----------
    states : array_like, shape (T+1, n), or a sequence of such
        One episode or several, each with the state before every action and after the last.
    actions : array_like, shape (T, m), or a sequence of such
        The inputs as they were executed (clipped, if the plant clips).
    dt : float
        Sampling time.
    disturbances : array_like, shape (T, d), or a sequence of such, optional
        Measured disturbances, which make E.
    x_ss, u_ss, d_ss : array_like, shapes (n,), (m,) and (d,), optional
        The operating point. Left out, inputs and disturbances take their mean, and the state is
        where the fitted model rests with them. Along what integrates, as far as the data tell, the
        state keeps its mean, and the inputs are those that hold it.
    offset : bool, default True
        Fit c too, so that the operating point need not be a steady state exactly. Without it,
        deviations from (x_ss, u_ss, d_ss), zeros where left out, are fitted with c = 0.
    ridge : float, default 0
        Weight of the squared entries, each in units of the spread of its regressor, relative to
        that of one step. It makes data that do not excite the plant usable, at the price of a
        bias towards zero that the standard errors do not contain.
    held_out : float, default 0.2
        Fraction of all steps that is kept out of the model to state its fit: the last ones, for
        which an episode is cut in two.
    time : array_like, shape (T+1,), or a sequence of such, optional
        When each row of the states was measured, in the unit of ``dt``. Steps that took another
        time, by more than 10 %, are left out: a log with missing rows is no record of the plant.

    Returns
    -------
    Identified

    Raises
    ------
    TypeError, ValueError
        For arrays that do not fit each other, hold NaN or are too few, and for data in which some
        combination of states and inputs does not move: the message names it.
    """
    found = fit_log(
        states,
        actions,
        dt=dt,
        disturbances=disturbances,
        x_ss=x_ss,
        u_ss=u_ss,
        d_ss=d_ss,
        offset=offset,
        ridge=ridge,
        held_out=held_out,
        time=time,
    )
    model, step = LinearModel(**vars(found.system)), found.regression
    A, B, E = np.split(
        step.standard_errors, [model.n_states, model.n_states + model.n_inputs], axis=1
    )
    return Identified(
        model=model,
        standard_error_A=A,
        standard_error_B=B,
        standard_error_E=E,
        noise_covariance=step.covariance,
        degrees_of_freedom=step.degrees_of_freedom,
        residual_autocorrelation=step.autocorrelation,
        one_step_fit=found.one_step_fit,
        ten_step_fit=found.ten_step_fit,
        excitation=step.excitation,
    )
