"""The closed loop of a law on its own model."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, check_array, check_int
from sb3_yann.control.mpc.choice import Law
from sb3_yann.control.mpc.misread_bounds import misread_in_words
from sb3_yann.control.mpc.problem import MPCProblem


def simulate(problem: MPCProblem, law: Law, theta0: ArrayLike, steps: int) -> tuple[Array, Array]:
    """Return what `LinearMPC.simulate` does.

    Parameters
    ----------
    problem, law : MPCProblem, and PiecewiseAffine or OnlineLaw
        The model, and what is played on it.
    theta0, steps : array_like, shape (n_theta,), and int
        The start, and the number of inputs.
    """
    shown = check_array("theta0", theta0, (problem.n_theta,))
    if words := misread_in_words(problem, shown[None]):
        raise ValueError(f"theta0 = {shown.tolist()}: {words}")
    count = check_int("steps", steps, hint="It counts the inputs that are played.")
    A, B = problem.prediction
    theta = problem.units.to_deviations(shown)
    thetas, inputs = np.empty((count + 1, len(theta))), np.empty((count, problem.model.n_inputs))
    thetas[0] = theta
    for k in range(count):
        inputs[k] = law(thetas[k])
        thetas[k + 1] = A @ thetas[k] + B @ inputs[k]
    return problem.units.to_plant(thetas), problem.units.input_to_plant(inputs)
