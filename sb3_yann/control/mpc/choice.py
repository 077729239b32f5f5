"""Which law of a problem is used: the explicit one where it is found soon, else the online one."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Protocol

from sb3_yann.control.explicit.budget import ExplicitLimitError
from sb3_yann.control.explicit.certificate import ExplicitSolutionError
from sb3_yann.control.law.piecewise_affine import PiecewiseAffine
from sb3_yann.control.online.online_law import OnlineLaw

Law = PiecewiseAffine | OnlineLaw
LAWS = ("auto", "explicit", "online")
SECONDS, REGIONS = 10.0, 5000
"""What "auto" spends on the search for an explicit law."""
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
        try:
            return problem.explicit(time_limit=SECONDS, region_limit=REGIONS)
        except (ExplicitLimitError, ExplicitSolutionError) as error:
            _warn(error)
    vars(problem)[CHOSEN] = True
    return problem.online()


def _warn(error: RuntimeError) -> None:
    warnings.warn(
        f"The program will be solved online, at each point: {str(error).partition(': ')[0]}. For "
        "the explicit law call problem.explicit() before, which has no limit by default; to skip "
        "the search, and this warning, choose law='online'.",
        OnlineLawWarning,
        stacklevel=4,
    )
