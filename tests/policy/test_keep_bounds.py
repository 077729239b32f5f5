"""The option of a policy to keep the hard bounds of its model, whatever it learns."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG

from policy_samples import build, scalar_mpc
from sb3_yann import SoftBounds
from sb3_yann.policy.checkpoint import ActorCheckpoint
from weights import last_layer, unpin


def pushing(model, towards: float = 9.0):
    """Let the networks push the input up with all that they have."""
    for actor in (model.policy.actor, model.policy.actor_target):
        unpin(actor)
        with th.no_grad():
            last_layer(actor)[..., -1] = towards
    return model


def largest(model, start: float = 0.0) -> float:
    """Return the largest state of a plant that is the model."""
    x, found = np.array([start]), -np.inf
    for _ in range(60):
        x = 1.1 * x + model.predict(x.astype(np.float32))[0]
        found = max(found, float(x[0]))
    return found


def test_it_is_on_where_there_are_hard_bounds_and_networks_do_not_take_over_beyond_them():
    assert build().policy.keep_bounds
    assert not build(mpc=scalar_mpc(soft=SoftBounds(x=1.0))).policy.keep_bounds
    free = scalar_mpc(x_min=None, x_max=None, theta_min=-5, theta_max=5)
    assert not build(mpc=free).policy.keep_bounds
    assert not build(mpc=scalar_mpc(infeasible="zero_input")).policy.keep_bounds
    assert not build(policy_kwargs={"keep_bounds": False}).policy.keep_bounds


def test_predictions_keep_the_bounds_that_others_break():
    kept, free = pushing(build()), pushing(build(policy_kwargs={"keep_bounds": False}))
    assert 4.999 < largest(kept) < 5 + 5e-6
    assert largest(free) > 100


def test_a_model_that_is_saved_and_loaded_keeps_them_as_far(tmp_path):
    model = pushing(build(policy_kwargs={"bounds_margin": 0.1}))
    assert abs(largest(model) - 4.5) < 1e-3
    model.policy.set_bounds_margin(0.2)
    assert abs(largest(model) - 4.0) < 1e-3
    model.save(tmp_path / "model")
    loaded = DDPG.load(tmp_path / "model")
    assert loaded.policy.bounds_margin == 0.2 and largest(loaded) == largest(model)
    off = pushing(build(policy_kwargs={"keep_bounds": False}))
    off.save(tmp_path / "off")
    assert largest(DDPG.load(tmp_path / "off")) == largest(off)


def test_a_checkpoint_knows_how_far_inside_its_actor_stays():
    model = pushing(build())
    before = ActorCheckpoint.of(model.policy)
    model.policy.set_bounds_margin(0.2)
    assert not before.is_actor_of(model.policy)
    assert ActorCheckpoint.of(model.policy).changed_regions(before).all()
    before.restore(model.policy)
    assert largest(model) > 4.999


def test_what_makes_no_sense_is_refused():
    with pytest.raises(ValueError, match=r"bounds_margin = -1 .*half-widths"):
        build(policy_kwargs={"bounds_margin": -1})
    with pytest.raises(TypeError, match="keep_bounds = 3"):
        build(policy_kwargs={"keep_bounds": 3})
    model = build(policy_kwargs={"keep_bounds": False})
    with pytest.raises(ValueError, match="keep_bounds=False: there is no margin"):
        model.policy.set_bounds_margin(0.1)
