"""What a controller takes for a fault."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_yann._validation import check_bounds, check_int, check_positive


@dataclass(frozen=True)
class Checks:
    """What a controller takes for a fault, and how it falls back.

    Parameters
    ----------
    obs_min, obs_max : array_like, shape (n_obs,), or float, optional
        Limits of the readings, in the units of the export. None is no limit. Readings are what the
        sensors say, not what an estimator makes of them.
    frozen_after : int, default 0
        A state that stays the same to the bit for so many steps in which another reading moves is
        frozen. 0 checks nothing: only you know how coarse a sensor is.
    missing : int or list of int, default 0
        For how many steps in a row a reading may be NaN before that is a fault, one number or one
        for each: 60 for a laboratory's hourly value among readings of every minute. An estimator
        goes on without it, elsewhere the last good one stands in.
    late_after : float, optional
        A step is late when more time has passed since the last one, in units of dt, 1.5 by default.
        It is checked where a step is passed the time. None checks nothing.
    hold : int, default 5
        Steps with a faulty reading that the last good one stands in for; then the output is held.
    recover : int, default 10
        Steps without a fault before the policy acts again. The MPC's law acts until then.
    transfer : int, default 5
        Steps within which a change of who acts fades.

    Examples
    --------
    >>> Checks(obs_min=[-2, -60], obs_max=[2, 20], frozen_after=30).hold
    5
    """

    obs_min: ArrayLike | None = None
    obs_max: ArrayLike | None = None
    frozen_after: int = 0
    missing: int | Sequence[int] = 0
    late_after: float | None = 1.5
    hold: int = 5
    recover: int = 10
    transfer: int = 5

    def arrays(self, size: int) -> dict[str, Any]:
        """Return them for ``size`` readings; TypeError or ValueError where one is wrong."""
        low, high = check_bounds("obs", self.obs_min, self.obs_max, size)
        counts: dict[str, Any] = {
            name: np.int64(check_int(name, getattr(self, name), 0))
            for name in ("frozen_after", "hold", "recover", "transfer")
        }
        late = np.inf
        if self.late_after is not None:
            late = check_positive("late_after", self.late_after, "None checks nothing.")
        given = np.ravel(self.missing).tolist()
        if len(given) not in (1, size):
            raise ValueError(f"missing = {self.missing} must be one number, or {size}.")
        missing = [check_int("missing", each, 0) for each in given]
        counts["missing"] = np.resize(np.array(missing, np.int64), size)
        return {"obs_min": low, "obs_max": high, "late_after": np.float64(late), **counts}
