"""Which law of a problem is used: the explicit one where it is found soon, else the online one."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Protocol

from sb3_yann.control.explicit.budget import ExplicitLimitError, SolveBudget
from sb3_yann.control.explicit.certificate import ExplicitSolutionError
from sb3_yann.control.explicit.parametric_qp import ParametricQP
from sb3_yann.control.law import PiecewiseAffine
from sb3_yann.control.online import OnlineLaw

Law = PiecewiseAffine | OnlineLaw
LAWS = ("auto", "explicit", "online")
EFFORT = 1.0
"""What "auto" spends on an explicit law, in what about a second does, by what it counts."""
REGIONS = 5000
"""The most regions of a law that "auto" takes."""
LARGE = 50_000
"""Constraints times parameters beyond which a single region takes long, and none is looked for."""
CHOSEN = "_online_chosen"


class OnlineLawWarning(UserWarning):
    """A problem has no explicit law within the budget, and its program is solved online instead.

    Examples
    --------
    >>> issubclass(OnlineLawWarning, UserWarning)
    True
    """


class Solvable(Protocol):
    """A problem whose laws can be asked for."""

    def explicit(
        self, solver: str = ..., *, time_limit: float | None = ..., region_limit: int | None = ...
    ) -> PiecewiseAffine:
        """Return the explicit law."""

    def _solved(self, budget: SolveBudget) -> PiecewiseAffine:
        """Return the explicit law within a budget."""

    def condensed(self) -> ParametricQP:
        """Return the program in U."""

    def online(self) -> OnlineLaw:
        """Return the online law."""


def choose(problem: Solvable, solved: Mapping[str, PiecewiseAffine], kind: str) -> Law:
    """Return the law of a kind, "auto" one of those that are ``solved``, or what the budget finds.

    That the online law was chosen is noted in the problem, and travels with it.
    """
    if kind == "auto" and solved:
        return next(iter(solved.values()))
    if kind == "explicit":
        return problem.explicit()
    if kind == "auto" and CHOSEN not in vars(problem):
        found = _searched(problem)
        if isinstance(found, PiecewiseAffine):
            return found
        warnings.warn(
            f"The program will be solved online, at each point. {found} To skip the search, and "
            "this warning, choose problem.law('online'), or law='online' of a policy.",
            OnlineLawWarning,
            stacklevel=3,
        )
    vars(problem)[CHOSEN] = True
    return problem.online()


def _searched(problem: Solvable) -> PiecewiseAffine | str:
    """Return the explicit law if it is found within the budget, else why it is not."""
    rows, n = problem.condensed().S.shape
    if rows * n > LARGE:
        return f"It has {rows} constraints on {n} parameters, too many to look for regions."
    try:
        return problem._solved(SolveBudget(region_limit=REGIONS, effort_limit=EFFORT))
    except ExplicitLimitError as error:
        return f"{error} Or call problem.explicit() before, which has no limit by default."
    except ExplicitSolutionError as error:
        return str(error)
