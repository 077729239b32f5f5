"""Control problems by name: what ``policy_kwargs={"problem": ...}`` and the spaces refer to."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from sb3_yann.control import LinearMPC
from sb3_yann_envs.spaces import resolve_reference

_registered: dict[str, LinearMPC | Callable[[], LinearMPC] | str] = {
    "CSTR-v0": "sb3_yann_envs.problems:cstr",
    "ClippedPendulum-v0": "sb3_yann_envs.problems:clipped_pendulum",
}


def register_problem(name: str, problem: LinearMPC | Callable[[], LinearMPC] | str) -> None:
    """Make ``problem`` known as ``name``, for YAML files and ``policy_kwargs``.

    Parameters
    ----------
    name : str
        Without a colon. Registering a name again replaces its problem.
    problem : LinearMPC, callable or str
        The problem, a function without arguments that returns it, or ``"module:attribute"``.

    Examples
    --------
    >>> register_problem("my-reactor", "sb3_yann_envs.problems:cstr")
    >>> resolve_problem("my-reactor", None).model.n_states
    4
    """
    if not isinstance(name, str) or not name or ":" in name:
        raise ValueError(f"name = {name!r} must be a non-empty string without ':'.")
    if not (isinstance(problem, LinearMPC | str) or inspect.isroutine(problem)):
        wanted = 'a LinearMPC, a function that returns one, or "module:attribute"'
        raise TypeError(f"problem = {problem!r} must be {wanted}.")
    _registered[name] = problem


def resolve_problem(problem: LinearMPC | str | None, observation_space: Any) -> LinearMPC:
    """Return the LinearMPC that is meant: given, named, or carried by the observation space."""
    if problem is None:
        problem = getattr(observation_space, "problem", None)
    if problem is None:
        raise ValueError(
            f"YannPolicy has no problem: the observation space {observation_space} carries none. "
            'Pass policy_kwargs={"problem": mpc} with a LinearMPC, a registered name '
            f'({", ".join(sorted(_registered))}) or "module:attribute".'
        )
    found: Any = problem
    if isinstance(found, str) and ":" not in found:
        if found not in _registered:
            raise ValueError(
                f"No problem is registered as {found!r}; there are {sorted(_registered)}. Call "
                'sb3_yann.register_problem, or refer to it as "module:attribute".'
            )
        found = _registered[found]
    if isinstance(found, str):
        found = resolve_reference(found)
    if inspect.isroutine(found):
        found = found()
    if not isinstance(found, LinearMPC):
        raise TypeError(f"problem = {problem!r} is {found!r}, expected a LinearMPC.")
    return found
