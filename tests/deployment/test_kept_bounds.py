"""Exported controllers keep the hard bounds of the model, whatever was learnt."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import general_problems
from deployed import COMPILERS, Compiled, disturbed, needs_compiler
from sb3_yann import Controller, export
from sb3_yann.control.mpc.bound_excess import Bounds
from structured_text import FunctionBlock


def largest_excess(mpc, act: Callable[[np.ndarray], np.ndarray], steps: int = 50) -> float:
    """Return the largest excess, in half-widths, of plants that are the model."""
    rng, kept, bounds, (A, B) = (
        np.random.default_rng(0),
        mpc.kept_set,
        Bounds.of(mpc),
        mpc.prediction,
    )
    theta = rng.uniform(mpc.theta_min, mpc.theta_max, (400, mpc.n_theta))
    theta = theta[(theta @ kept.F.T <= kept.g).all(axis=1)][:8]
    found = 0.0
    for _ in range(steps):
        theta = theta @ A.T + np.array([act(each) for each in theta]) @ B.T
        found = max(found, float(np.abs(bounds.beyond(theta)).max()))
    return found


@needs_compiler
@pytest.mark.parametrize("name", ["servo with a disturbance", "two tanks, all parts"])
def test_numpy_c_and_structured_text_keep_them_with_any_weights(name, tmp_path):
    mpc = general_problems.solved(name)
    policy = disturbed(mpc, size=5.0, networks="shared", pin_equilibrium=False)
    code = Compiled(policy, tmp_path, compiler=COMPILERS[0])
    export(policy, tmp_path / "plant.st")
    block = FunctionBlock((tmp_path / "plant.st").read_text())
    assert largest_excess(mpc, code.controller.evaluate) < 2e-6  # 1e-6 of the range
    assert largest_excess(mpc, lambda obs: code.at(obs[None])[0][0]) < 2e-6
    assert largest_excess(mpc, lambda obs: np.array(block.step(obs=list(obs), request=0)[0])) < 2e-6
    without = {**code.controller.data, "kept": code.controller.data["kept"][:0]}
    assert largest_excess(mpc, Controller(without).evaluate) > 0.01
