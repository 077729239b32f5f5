"""Limits of the search for the regions of a law."""

from __future__ import annotations

import time
from typing import NoReturn

import numpy as np

from sb3_yann._progress import bar
from sb3_yann._validation import check_int, check_positive


class ExplicitLimitError(RuntimeError):
    """The search for the regions of a law ran into ``time_limit`` or ``region_limit``.

    Attributes
    ----------
    n_regions : int
        How many regions were found until then, where the solver says.
    """

    def __init__(self, message: str, n_regions: int) -> None:
        super().__init__(message)
        self.n_regions = n_regions


class BudgetTimer:
    """Counts regions and, from now on, the time of a search and its check; ends them at a limit.

    Limits are in seconds, regions and effort; None is no limit.
    It also sums up effort: what each linear program, QP and factorization takes by its size, in
    seconds of a processor of 2024 with nothing else to do. That is the same on every machine.
    """

    def __init__(
        self,
        time_limit: float | None = None,
        region_limit: int | None = None,
        effort_limit: float | None = None,
    ) -> None:
        if time_limit is not None:
            check_positive("time_limit", time_limit, "It is in seconds; None is no limit.")
        if region_limit is not None:
            check_int("region_limit", region_limit, hint="None is no limit.")
        self.time_limit = np.inf if time_limit is None else time_limit
        self.region_limit = np.inf if region_limit is None else region_limit
        self.effort_limit = np.inf if effort_limit is None else effort_limit
        self.effort = 0.0
        self.found = 0
        self._start = time.monotonic()
        self._done = ""
        self._bar = bar("critical regions")

    def __enter__(self) -> BudgetTimer:
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.close()

    def count(self, more: int = 1) -> None:
        """Count regions; raise ExplicitLimitError if these are too many, or the time is over."""
        self.found += more
        self._bar.update(more)
        if self.found > self.region_limit:
            self._stop(f"The law has more than region_limit = {self.region_limit} regions")
        self.tick()

    def stage(self, name: str, done: str, steps: int) -> None:
        """Begin to show another stage, of so many steps; ``done`` says what has been before."""
        self._bar.close()
        self._done = f" {done}"
        self._bar = bar(name, total=steps)

    def advance(self) -> None:
        """Count a step of a stage; raise ExplicitLimitError if the time is over."""
        self._bar.update()
        self.tick()

    def tick(self, effort: float = 0.0) -> None:
        """Count effort ahead; raise ExplicitLimitError if it is too much, or time is over."""
        self.effort += effort
        if self.effort > self.effort_limit:
            self._stop("The law takes more effort than about a second of a fast processor")
        if time.monotonic() - self._start > self.time_limit:
            self._stop(f"The law was not solved in time_limit = {self.time_limit:g} s")

    def left(self) -> float:
        """Return for how many seconds the search may go on, infinite without a limit."""
        return max(0.0, self._start + self.time_limit - time.monotonic())

    def _stop(self, what: str) -> NoReturn:
        found = f"{self.found} regions were found in {time.monotonic() - self._start:.1f} s"
        raise ExplicitLimitError(
            f"{what}: {found}{self._done}. Their number grows with the horizon and the bounds: "
            "shorten the horizon, leave out bounds that hardly matter, make theta_min and "
            "theta_max narrower, or raise the limit.",
            self.found,
        )


OF_REGION = 6e-4
"""The effort of a candidate for a region besides its programs: Python."""


def effort_of_lp(rows: int, variables: int) -> float:
    """Return the effort of a linear program with inequality constraints."""
    return 1e-5 + 2e-9 * rows * variables**2


def effort_of_qp(rows: int, variables: int) -> float:
    """Return the effort of a quadratic program from DAQP."""
    return 2e-5 + 4e-9 * rows * variables + 4e-9 * variables**2


def effort_of_conditions(rows: int, variables: int, active: int) -> float:
    """Return the effort of the conditions of one active set."""
    return 2e-6 + 2e-9 * (rows + variables) * (variables + active) * max(1, active)
