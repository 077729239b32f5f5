"""A Box space that carries the control problem of its environment."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

if TYPE_CHECKING:
    _Box = Box[np.floating[Any]]
else:  # Box cannot be subscripted at run time in every Gymnasium 1.x
    _Box = Box


class ProblemBox(_Box):
    """A Box that also tells an agent which control problem its environment poses.

    A Stable-Baselines3 policy receives the spaces of an environment and nothing else of it. The
    problem therefore travels on the observation space, through copies, pickles and saved models.

    Parameters
    ----------
    low, high : float or ndarray
        Bounds, as in `gymnasium.spaces.Box`.
    shape : sequence of int, optional
        Shape of an element; taken from the bounds if they are arrays.
    dtype : type, default numpy.float32
        Floating point type of an element.
    seed : int or numpy.random.Generator, optional
        Seed of `sample`.
    problem : object or str
        The problem, or a reference ``"module:attribute"`` to it. A reference is resolved at the
        first access of `problem`, so the space costs nothing to agents that do not ask for it.

    Raises
    ------
    ValueError
        If `problem` is None, or a string not of the form ``"module:attribute"``.

    Notes
    -----
    Spaces with equal bounds are equal whatever problem they carry: Gymnasium and Stable-Baselines3
    use ``==`` to decide whether an environment fits a model. Wrappers that build a new space
    (`FlattenObservation`, frame stacks) drop the problem with it.

    Examples
    --------
    >>> space = ProblemBox(-1.0, 1.0, (2,), problem="sb3_yann_envs.problems:cstr")
    >>> space.problem.horizon
    2
    """

    def __init__(
        self,
        low: float | NDArray[Any],
        high: float | NDArray[Any],
        shape: Sequence[int] | None = None,
        dtype: type[np.floating[Any]] = np.float32,
        seed: int | np.random.Generator | None = None,
        *,
        problem: object,
    ) -> None:
        super().__init__(low, high, shape, dtype=dtype, seed=seed)
        if problem is None:
            raise ValueError(
                "problem must be an object or a reference 'module:attribute', got None. Use "
                "gymnasium.spaces.Box for an observation without a control problem."
            )
        self._reference = problem if isinstance(problem, str) else None
        self._problem = None if isinstance(problem, str) else problem
        if self._reference is not None:
            _split_reference(self._reference)  # a malformed one fails here, not in the first agent

    @property
    def problem(self) -> object:
        """The control problem; a reference is resolved on first access and then kept."""
        if self._problem is None and self._reference is not None:
            self._problem = resolve_reference(self._reference)
        return self._problem

    def __repr__(self) -> str:
        """Return the Box representation with the reference, or the type, of the problem."""
        problem = self._reference or f"<{type(self._problem).__name__}>"
        return f"Problem{super().__repr__()[:-1]}, problem={problem})"


def _split_reference(reference: str) -> tuple[str, str]:
    """Return module and attribute of a reference ``"module:attribute"``."""
    module, colon, attribute = reference.partition(":")
    names = [*module.split("."), attribute]
    if not colon or not all(name.isidentifier() for name in names):
        raise ValueError(
            f"problem={reference!r} is not a valid reference: write 'module:attribute', e.g. "
            "'my_package.problems:my_problem'."
        )
    return module, attribute


def resolve_reference(reference: str) -> object:
    """Return the object that ``"module:attribute"`` names; a function is called for it.

    A reference to what does not exist is a ValueError.
    """
    module_name, attribute = _split_reference(reference)
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        # A module that exists but lacks a dependency must report that dependency.
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise
        raise ValueError(
            f"problem={reference!r}: there is no module {error.name!r}. Install it, or correct "
            "the part of the reference before the colon."
        ) from error
    if not hasattr(module, attribute):
        raise ValueError(
            f"problem={reference!r}: module {module_name!r} has no attribute {attribute!r}. "
            "Correct the part of the reference after the colon."
        )
    target = getattr(module, attribute)
    # isroutine, unlike isfunction, also accepts a factory under functools.cache.
    problem: object = target() if inspect.isroutine(target) else target
    if problem is None:
        raise ValueError(
            f"problem={reference!r} resolved to None. A factory has to return the problem."
        )
    return problem
