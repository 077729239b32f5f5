"""What holds for the law of any problem: random plants, bounds, units and parts of theta."""

from __future__ import annotations

import pickle
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from partitions import (
    as_range,
    balls,
    edges,
    kinds,
    mixture,
    slacks,
    steepest,
    unit_half,
)
from random_problems import examples, in_box, problems, room
from sb3_yann import LinearMPC

SEEDS = st.integers(0, 2**32 - 1)


@pytest.mark.slow
@examples(8)
@given(problems(), SEEDS)
def test_regions_cover_what_is_feasible_and_nothing_else(mpc: LinearMPC, seed: int) -> None:
    law, online = mpc.explicit(), mpc.online()
    points = in_box(mpc, 15, seed=seed)
    at_edge, ways = edges(law, seed, each=1)
    across = (at_edge + 1e-3 * ways)[:5]
    for theta in np.vstack([points, across[np.all(across <= law.theta_max, axis=1)]]):
        if np.any(theta < law.theta_min):
            continue
        free = room(mpc, theta)
        if abs(free) > 1e-6:  # what is nearer HiGHS does not tell
            assert law.in_domain(theta) == (free > 0)
            assert online.in_domain(theta) == (free > 0)


@examples(8)
@given(problems(), SEEDS)
def test_no_two_regions_overlap(mpc: LinearMPC, seed: int) -> None:
    law, rng = mpc.explicit(), np.random.default_rng(seed)
    assert np.sum(slacks(law, in_box(mpc, 1000, seed=seed)) > 1e-9, axis=1).max() <= 1
    for region, (center, radius) in enumerate(balls(law)):
        assert radius > 0
        ball = rng.normal(size=(20, law.n_theta))
        ball *= rng.uniform(0, 0.99, (20, 1)) * radius / np.linalg.norm(ball, axis=1)[:, None]
        holders = slacks(law, center + unit_half(law) * ball)
        assert np.all(holders[:, region] > 0)
        assert np.sum(holders > 1e-9, axis=1).max() <= 1


@pytest.mark.slow
@examples(8)
@given(problems(), SEEDS, st.sampled_from([1e-9, 1e-6, 1e-3]))
def test_law_has_no_jump_in_the_feasible_set(mpc: LinearMPC, seed: int, step: float) -> None:
    law = mpc.explicit()
    at, ways = edges(law, seed)
    one, other = at - step * ways, at + step * ways
    # The feasible set is convex: from one to the other the input follows the gains on the way.
    for each in kinds(mpc):
        kept = each.in_domain(one) & each.in_domain(other)
        change = as_range(law, each(one) - each(other))[kept]
        assert np.all(change <= 2 * step * steepest(law) + 1e-9)


@examples(8)
@given(problems(), SEEDS)
def test_size_and_order_of_a_batch_change_no_bit(mpc: LinearMPC, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for law, points in (
        (mpc.explicit(), mixture(mpc, seed)),
        (mpc.online(), mixture(mpc, seed)[::5]),
    ):
        whole, order = law(points), rng.permutation(len(points))
        anew = pickle.loads(pickle.dumps(law))  # an online law remembers its answers
        np.testing.assert_array_equal(anew(points[order]), whole[order])
        alone = pickle.loads(pickle.dumps(law))
        np.testing.assert_array_equal([alone(each) for each in points[order]], whole[order])
        np.testing.assert_array_equal(law.in_domain(points[order]), law.in_domain(points)[order])


@examples(8)
@given(problems(), st.data(), st.sampled_from([np.float32, np.float64]))
def test_every_number_has_an_input_within_its_bounds(mpc: LinearMPC, data, dtype) -> None:
    width = 8 * np.dtype(dtype).itemsize
    numbers = st.floats(width=width, allow_nan=False, allow_infinity=False)
    rows = st.lists(numbers, min_size=mpc.n_theta, max_size=mpc.n_theta)
    points = np.array(data.draw(st.lists(rows, min_size=1, max_size=6)), dtype)
    for law in kinds(mpc):
        u = law(points)
        assert np.all((law.u_min <= u) & (u <= law.u_max))
        np.testing.assert_array_equal(law(points[0]), u[0])


@examples(8)
@given(problems(), SEEDS)
def test_law_is_saved_to_the_last_bit(mpc: LinearMPC, seed: int) -> None:
    points = mixture(mpc, seed)[::5]
    with tempfile.TemporaryDirectory() as folder:
        for law in kinds(mpc):
            law.save(Path(folder) / "law.npz")
            loaded = type(law).load(Path(folder) / "law.npz")
            assert (loaded, hash(loaded)) == (law, hash(law))
            assert loaded.model == law.model
            np.testing.assert_array_equal(loaded.theta_ss, law.theta_ss)
            np.testing.assert_array_equal(loaded(points), law(points))
