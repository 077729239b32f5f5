"""A law's plant: where theta and the input count from, the sampling time, names and units."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import Array, ReadOnlyArrays, check_array, to_float
from sb3_yann.control.model.linear_model import LinearModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from typing_extensions import Self

Law = TypeVar("Law", bound="OnPlant")
MODEL = "model_"
LISTS = ("notes", "state_names", "input_names", "units", "estimated")


class OnPlant(ReadOnlyArrays):
    """What a law of a :class:`LinearMPC` knows of its plant; it is saved with the law.

    Equality ignores it.

    Attributes
    ----------
    model : LinearModel or None
        With operating point, dt, names and units. None for a law that was built by hand.
    theta_ss : ndarray, shape (n_theta,), or None
        Theta at the operating point, as the plant shows it: of a state its x_ss.
    """

    # No annotations in a dataclass: these are no arguments of a law.
    model: LinearModel | None = None
    theta_ss: Array | None = None

    if TYPE_CHECKING:

        @property
        def n_theta(self) -> int:
            """Number of parameters."""

        @property
        def n_inputs(self) -> int:
            """Number of inputs."""

        def __getstate__(self) -> dict[str, Any]:
            """Return what is kept of it."""

        def __call__(self, theta: ArrayLike) -> Array:
            """Return the input, both in deviations."""

    def on_plant(self, model: LinearModel, theta_ss: ArrayLike) -> Self:
        """Return the same law with its plant; theta_ss is (n_theta,)."""
        law = object.__new__(type(self))
        own = {"model": model, "theta_ss": np.array(theta_ss, np.float64)}
        law.__setstate__({**self.__getstate__(), **own})
        return law

    def plant_input(self, shown: ArrayLike) -> Array:
        """Return the input as the plant takes it, for theta as the plant shows it.

        Parameters
        ----------
        shown : array_like, shape (n_theta,) or (batch, n_theta)
            References, disturbances and the previous input count from the plant's zero too.

        Raises
        ------
        ValueError
            If the law knows no plant.

        Examples
        --------
        >>> from sb3_yann.control import LinearMPC
        >>> tank = LinearModel([[0.9]], [[0.5]], dt=1, x_ss=[12], u_ss=[3])
        >>> weights = {"Q": [[1]], "R": [[1]], "horizon": 3}
        >>> limits = {"x_min": 0, "x_max": 20, "u_min": 0, "u_max": 10, "absolute": True}
        >>> law = LinearMPC(tank, **weights, **limits).explicit()
        >>> law.plant_input([12.0])
        array([3.])
        """
        if self.model is None or self.theta_ss is None:
            raise ValueError(
                "The law knows no operating point: it was built by hand. Take it from "
                "LinearMPC.explicit() or online(), or add the point yourself: "
                "u_ss + law(shown - theta_ss)."
            )
        values = to_float("shown", shown)
        if values.shape[-1:] != self.theta_ss.shape:
            size = len(self.theta_ss)
            raise ValueError(
                f"shown has shape {values.shape}, expected ({size},) or (batch, {size})."
            )
        return np.asarray(self(values - self.theta_ss) + self.model.u_ss)

    def plot(self, axes: Axes | None = None, **options: Any) -> Axes:
        """Draw the regions by :func:`~sb3_yann.control.law.plot.plot_regions`; return the axes.

        Options are those of that function: ``entries``, ``at``, ``labels``, ``name``. A law that is
        solved online has no regions, and is a ValueError.
        """
        from sb3_yann.control.law.plot import plot_regions

        return plot_regions(self, axes, **options)


def plant_arrays(law: OnPlant) -> dict[str, Any]:
    """Return what a law knows of its plant as arrays for its file; nothing for an unknown one."""
    if law.model is None:
        return {}
    return {"theta_ss": law.theta_ss, **{MODEL + k: v for k, v in vars(law.model).items()}}


def with_plant(law: Law, data: dict[str, Any]) -> Law:
    """Return a law with the plant of its file; as it is where the file has none.

    Parameters
    ----------
    law : PiecewiseAffine or OnlineLaw
        Without a plant.
    data : dict of str to ndarray
        The file's. What is missing or damaged raises some error.
    """
    if not any(name == "theta_ss" or name.startswith(MODEL) for name in data):
        return law
    data = {MODEL + "estimated": np.empty(0), **data}  # files of before it
    given = {each.name: data[MODEL + each.name] for each in fields(LinearModel)}
    given |= {name: given[name].tolist() for name in LISTS}
    model, m = LinearModel(**{**given, "dt": float(given["dt"])}), law.n_inputs
    if model.n_inputs != m or model.n_states > law.n_theta:
        raise ValueError(f"its model has {model.n_states} states and {model.n_inputs} inputs")
    return law.on_plant(model, check_array("theta_ss", data["theta_ss"], (law.n_theta,)))
