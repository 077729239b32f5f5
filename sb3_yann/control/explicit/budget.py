"""Limits of the search for the regions of a law, and its progress."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from tqdm import tqdm  # type: ignore[import-untyped]

_ADVICE = (
    "Their number grows fastest with the horizon and with the number of bounds: shorten the "
    "horizon, leave out bounds that hardly matter, make the box of parameters smaller (theta_min, "
    "theta_max), or raise the limit."
)


class ExplicitLimitError(RuntimeError):
    """The search for the regions of a law ran into ``time_limit`` or ``region_limit``.

    Attributes
    ----------
    n_regions : int
        How many regions were found until then, where the solver tells.

    Examples
    --------
    >>> try:
    ...     raise ExplicitLimitError("The law has too many regions.", 100)
    ... except ExplicitLimitError as error:
    ...     error.n_regions
    100
    """

    def __init__(self, message: str, n_regions: int) -> None:
        super().__init__(message)
        self.n_regions = n_regions


@dataclass(frozen=True)
class SolveBudget:
    """How long a search may take.

    Attributes
    ----------
    time_limit : float, optional
        In seconds.
    region_limit : int, optional
        The largest number of regions.
    progress : bool, default False
        Show a progress bar that counts regions.
    """

    time_limit: float | None = None
    region_limit: int | None = None
    progress: bool = False

    def __post_init__(self) -> None:
        seconds, regions = self.time_limit, self.region_limit
        if seconds is not None and not (
            isinstance(seconds, int | float) and math.isfinite(seconds) and seconds > 0
        ):
            raise ValueError(
                f"time_limit = {seconds!r} must be a number of seconds above 0, or None for no "
                "limit."
            )
        if regions is not None and not (
            isinstance(regions, int) and not isinstance(regions, bool) and regions > 0
        ):
            raise ValueError(
                f"region_limit = {regions!r} must be a whole number above 0, or None for no limit."
            )

    def require(self, n_regions: int) -> None:
        """Raise ExplicitLimitError if a law that is there has too many regions."""
        if self.region_limit is not None and n_regions > self.region_limit:
            raise ExplicitLimitError(
                f"The law has {n_regions} regions, more than region_limit = {self.region_limit}. "
                f"{_ADVICE}",
                n_regions,
            )


class BudgetTimer:
    """Counts the regions of one search, shows them, and ends it at its limits.

    The time counts from when this is made.
    """

    def __init__(self, budget: SolveBudget) -> None:
        self.budget, self.found, self._start = budget, 0, time.monotonic()
        self._bar = tqdm(
            desc="Critical regions", unit=" regions", leave=False, disable=not budget.progress
        )

    def __enter__(self) -> BudgetTimer:
        return self

    def __exit__(self, *error: object) -> None:
        """Take the progress bar away."""
        self._bar.close()

    @property
    def seconds(self) -> float:
        """How long the search has taken."""
        return time.monotonic() - self._start

    def count(self, more: int = 1) -> None:
        """Count regions; raise ExplicitLimitError if these are too many, or the time is over."""
        self.found += more
        self._bar.update(more)
        most = self.budget.region_limit
        if most is not None and self.found > most:
            self._stop(f"The law has more than region_limit = {most} regions")
        self.tick()

    def tick(self) -> None:
        """Raise ExplicitLimitError if the time is over."""
        most = self.budget.time_limit
        if most is not None and self.seconds > most:
            self._stop(f"The law was not solved in time_limit = {most:g} s")

    def _stop(self, what: str) -> None:
        raise ExplicitLimitError(
            f"{what}: {self.found} were found in {self.seconds:.1f} s. {_ADVICE}",
            self.found,
        )
