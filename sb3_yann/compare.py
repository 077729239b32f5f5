"""When a policy is less safe than another from the same starts: one rule for whoever compares."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_yann._validation import Array
from sb3_yann.control.mpc.bound_excess import BoundExcess

UNSAFE = (
    "violations",
    "an episode that the env ends, or ends sooner",
    "a cost or an observation that is no finite number",
    "an input that moves too far in one step",
    "a larger excess over the problem's bounds",
    "a larger summed excess over the problem's bounds",
)
"""What the columns of ``unsafe`` are. A seventh is the excess over hard and soft bounds."""
SUCCESS = 'where an end is a success, the env says so by info["is_success"]'
"""What to do about an env that ends an episode because its goal is reached."""
EXCESS_ROOM = 1e-3
"""Half-widths of a bound by which an excess may be larger: less is noise."""
EXCESS_SHARE = 0.1
"""Share of the MPC's own excess by which it may be larger: an MPC that rides a bound is no veto."""


def unsafe_columns(
    violations: ArrayLike,
    ended: ArrayLike,
    lost: ArrayLike,
    excess: BoundExcess,
    far: ArrayLike = 0,
) -> Array:
    """Return what :func:`less_safe` compares, (episodes, 7).

    Parameters
    ----------
    violations, ended, lost, far : array_like, shape (episodes,)
        Steps in which the env reports a violation; how early the env ends an episode; whether its
        cost or an observation is not finite; steps in which an input moves too far.
    excess : BoundExcess
        Over the bounds of the problem.
    """
    size = np.shape(excess.largest)
    columns = [violations, ended, lost, far, excess.largest, excess.summed, excess.any_bound]
    return np.column_stack([np.broadcast_to(each, size).astype(np.float64) for each in columns])


def less_safe(now: Array, before: Array, room: float = EXCESS_ROOM) -> NDArray[np.bool_]:
    """Tell which episodes are less safe than before, and in what (episodes, 6).

    - The largest excess of an episode may be larger by ``room`` and by ``EXCESS_SHARE`` of what it
      was. So may the summed one, and by one step of the largest besides. It counts where it is
      larger on average over all episodes, too.
    - Where the env reported violations before, and the problem's bounds tell their size, a tenth
      more steps of them, or one, count only where they are larger.
    - Of all else nothing may be more.

    Parameters
    ----------
    now, before : ndarray, shape (episodes, 7)
        As :func:`unsafe_columns` returns them, of the same starts.
    room : float
        Half-widths of a bound by which an excess may be larger.
    """
    more = now[:, : len(UNSAFE)] > before[:, : len(UNSAFE)]
    larger = ~(now <= allowed_excess(before, room))
    few = now[:, 0] <= before[:, 0] + np.maximum(1.0, EXCESS_SHARE * before[:, 0])
    known = (before[:, 0] > 0) & (now[:, 6] > 0) & few & ~larger[:, 6]
    more[:, 0] &= ~known
    more[:, 4] = larger[:, 4]
    step = before[:, 4]  # one more of the largest
    longer = ~(now[:, 5] <= allowed_excess(before[:, 5], room) + step)
    mean = allowed_excess(before[:, 5].mean(), room) if len(now) else 0.0
    least = mean + step.max(initial=0.0) / max(len(now), 1)
    more[:, 5] = longer & (len(now) > 0 and not now[:, 5].mean() <= least)
    return np.asarray(more)


def allowed_excess(excess: ArrayLike, room: float = EXCESS_ROOM) -> Array:
    """Return the excess that is no larger than another: it rides the same bound."""
    return np.asarray((1 + EXCESS_SHARE) * np.asarray(excess) + room)
