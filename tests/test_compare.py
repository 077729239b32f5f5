"""When a policy is less safe than another from the same starts."""

import numpy as np
import pytest

from sb3_yann.compare import less_safe, unsafe_columns
from sb3_yann.control.mpc.bound_excess import BoundExcess


def columns(*episodes: list[float], violations: object = 0) -> np.ndarray:
    """Return what is unsafe of episodes that exceed one bound by so much, step by step."""
    largest = np.array([max(each, default=0.0) for each in episodes])
    summed = np.array([sum(each) for each in episodes])
    return unsafe_columns(
        violations, 0, 0, BoundExcess(largest, summed, largest, np.zeros(len(episodes)))
    )


@pytest.mark.parametrize(
    ("mpc", "policy", "worse"),
    [
        ([0.04] * 5, [0.04] * 6, False),  # as large, one step more
        ([0.04] * 2, [0.04] * 3, False),
        ([0.04] * 5, [0.04] * 9, True),  # as large, and much longer
        ([0.04] * 5, [0.06], True),  # larger
        ([0.04] * 5, [0.044] * 5, False),
        ([], [0.0009], False),
        ([], [0.5], True),
        ([0.5], [np.inf], True),
        ([2.0, 1.0], [], False),
    ],
)
def test_an_excess_is_worse_by_its_size_and_not_by_a_step(
    mpc: list[float], policy: list[float], worse: bool
) -> None:
    assert bool(less_safe(columns(policy), columns(mpc)).any()) == worse


def test_one_step_more_in_some_episodes_passes_and_in_all_of_many_does_not() -> None:
    mpc = columns(*[[0.3] * 5] * 20)
    some = columns(*[[0.3] * 6] * 8, *[[0.3] * 4] * 8, *[[0.3] * 5] * 4)
    assert not less_safe(some, mpc).any()
    assert less_safe(columns(*[[0.3] * 7] * 20), mpc)[:, 5].all()


def test_a_reported_violation_more_counts_unless_its_size_is_known_and_no_larger() -> None:
    mpc = columns([0.04] * 10, violations=10)
    assert not less_safe(columns([0.04] * 11, violations=11), mpc).any()
    assert less_safe(columns([0.09] * 11, violations=11), mpc)[0, 0]
    assert less_safe(columns([], violations=11), columns([], violations=10))[0, 0]
    assert less_safe(columns([], violations=1), columns([]))[0, 0]


def test_a_wider_room_lets_more_pass() -> None:
    assert less_safe(columns([0.05]), columns([])).any()
    assert not less_safe(columns([0.05]), columns([]), room=0.06).any()
