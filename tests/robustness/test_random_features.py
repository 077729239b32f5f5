"""Random problems of each feature of the MPC: 200 alone and 100 together, the worst printed."""

from __future__ import annotations

import pytest

from sparse_qp import FEATURES, worst_difference

CASES = [*(((name,), 200) for name in FEATURES), (FEATURES, 100)]


@pytest.mark.nightly
@pytest.mark.parametrize(("features", "count"), CASES, ids=lambda each: str(each))
def test_random_problems_agree_with_sparse_programs(
    features: tuple[str, ...], count: int, capsys: pytest.CaptureFixture[str]
) -> None:
    found = [worst_difference(features, seed, points=4) for seed in range(count)]
    worst = max(range(count), key=lambda seed: found[seed][0])
    points = sum(each[1] for each in found)
    with capsys.disabled():
        print(
            f"\n{' + '.join(features)}: {count} problems, {points} points, worst "
            f"{found[worst][0]:.1e} half-ranges (seed {worst})"
        )
    assert points > 2 * count and found[worst][0] < 1e-8
