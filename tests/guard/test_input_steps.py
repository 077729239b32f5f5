"""A rule may bound how far inputs move from one sample to the next."""

from __future__ import annotations

import numpy as np
import pytest

from guard_samples import LEFT, REGION, RIGHT, STEPS, At, correct, make_guard, tried
from weights import is_mpc, last_layer


def restless(policy) -> None:
    """Cost less in both saturated regions, and enter the middle one with a larger step."""
    correct(policy, LEFT, -0.7)
    correct(policy, RIGHT, 0.7)


def decided(max_input_step):
    model, guard = tried(restless, rule={"max_input_step": max_input_step}, n_new_starts=50)
    return model, guard


@pytest.mark.parametrize("max_input_step", [None, 3.0])
def test_a_cheaper_policy_is_accepted_without_a_bound_or_within_it(max_input_step) -> None:
    model, guard = decided(max_input_step)
    assert guard.decisions[0].verdict == "accepted"
    assert float(last_layer(model)[REGION[RIGHT], 0, -1].detach()) == np.float32(0.7)


def test_beyond_the_bound_it_is_refused_with_the_reason() -> None:
    model, guard = decided(1.0)
    assert guard.decisions[0].verdict == "rejected"
    assert "an input that moves too far in one step" in guard.decisions[0].reason
    assert is_mpc(model)
    mpc = guard.state.evidence.starts.mpc
    assert not mpc.unsafe[:, 3].any()  # the MPC itself never counts


def test_a_model_that_goes_on_knows_the_bound(tmp_path) -> None:
    model, guard = decided(1.0)
    bound = guard.state.max_input_step
    model.save(tmp_path / "model")
    again = type(model).load(tmp_path / "model", env=model.get_env(), device="cpu")
    later = make_guard(rule={"max_input_step": 1.0})
    again.learn(STEPS + 1, callback=[At([STEPS], restless), later], reset_num_timesteps=False)
    np.testing.assert_array_equal(later.state.max_input_step, bound)
    assert later.decisions[-1].verdict == "rejected"
