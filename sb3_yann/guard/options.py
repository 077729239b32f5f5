"""The guard's little-used settings, in groups that check themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from sb3_yann._validation import check_bool, check_range
from sb3_yann.compare import EXCESS_ROOM


@dataclass(frozen=True)
class AcceptanceRule:
    """When a candidate counts as no worse.

    Parameters
    ----------
    margin : float, default 0.01
        What the worst starts may cost more than with the MPC on average, as a fraction of the
        MPC's median cost, or of its cost of that start where that is more. No single start may
        cost ten times as much more.
    tail : float, default 0.05
        Share of the starts that count as the worst ones. 0 is strict: no single
        start may cost more than the margin, of the median.
    by_region : bool, default True
        Whether single regions are tried where the whole candidate is refused.
    retreat : bool, default True
        Whether half and a quarter of the way are tried where no region is accepted either, and
        half and a quarter of the correction where a policy loses on new starts.
    significance : float, default 0.05
        Probability that the final trial accepts a policy that is no better on average over all
        starts.
    least_gain : float, default 0.001
        What the final trial must gain on average, as a fraction of the MPC's mean cost. What gains
        less changes nothing. A strict rule, ``tail=0``, takes any gain.
    largest_step : float, optional
        How far an input may move from one sample to the next, in multiples of the MPC's largest
        step on the known starts, at least 1. The default is no bound.
    excess_room : float, default 0.001
        How much farther than the MPC a policy may exceed a hard bound of the problem, in
        half-widths of theta's box, besides a tenth of the MPC's own excess. It holds for the
        largest excess of an episode and for the sum over its steps, which may be larger by one
        step as well. The costs count what soft bounds cost the MPC.

    Examples
    --------
    >>> from sb3_yann import AcceptanceRule
    >>> AcceptanceRule(margin=0.02, by_region=False).significance
    0.05
    """

    margin: float = 0.01
    tail: float = 0.05
    by_region: bool = True
    retreat: bool = True
    significance: float = 0.05
    least_gain: float = 0.001
    largest_step: float | None = None
    excess_room: float = EXCESS_ROOM

    def __post_init__(self) -> None:
        check_range("margin", self.margin, 0, np.inf)
        check_range(
            "tail", self.tail, 0, 1, hint="It is a share of the starts, 0 for the worst one."
        )
        hint = "It is a share of the MPC's mean cost, 0 for any gain."
        check_range("least_gain", self.least_gain, 0, 1, hint=hint)
        hint = "It is in half-widths of theta's box, 0 for the MPC's own excess and a tenth."
        check_range("excess_room", self.excess_room, 0, np.inf, hint=hint)
        if self.largest_step is not None:
            hint = "It is a multiple of the MPC's largest step, or None."
            check_range("largest_step", self.largest_step, 1, np.inf, hint=hint)
        check_bool("by_region", self.by_region)
        check_bool("retreat", self.retreat)
        check_range("significance", self.significance, 0, 0.5)

    @property
    def standard_errors(self) -> float:
        """How many standard errors a mean cost must be below the MPC's in the final trial."""
        return float(special.ndtri(1 - self.significance)) if self.tail else 0.0


@dataclass(frozen=True)
class StepSize:
    """How decisions scale the actor's learning rate.

    Parameters
    ----------
    shrink : float, default 0.5
        Factor after the accepted policy has been restored.
    grow : float, default 1.5
        Factor after an acceptance. The product never exceeds 1.
    smallest : float, default 0.1
        The product never falls below this.

    Examples
    --------
    >>> from sb3_yann import StepSize
    >>> StepSize(shrink=0.3).grow
    1.5
    """

    shrink: float = 0.5
    grow: float = 1.5
    smallest: float = 0.1

    def __post_init__(self) -> None:
        check_range("shrink", self.shrink, 0, 1)
        check_range("grow", self.grow, 1, np.inf)
        check_range("smallest", self.smallest, 0, 1)
