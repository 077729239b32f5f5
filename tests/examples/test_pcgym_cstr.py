"""The example of PC-Gym's reactor: its length, and that its policy starts as its MPC."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import DDPG

SCRIPT = Path(__file__).parents[2] / "examples" / "pcgym_cstr.py"


def test_it_takes_twenty_lines() -> None:
    tree = ast.parse(SCRIPT.read_text(encoding="utf-8"))
    left_out = (ast.Import, ast.ImportFrom, ast.If)  # the last one calls main
    lines = set()
    for node in ast.walk(tree):
        text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node, ast.stmt) and not isinstance(node, left_out) and not text:
            lines.add(node.lineno)
    assert len(lines) <= 21  # twenty, and the call of main


@pytest.mark.skipif(importlib.util.find_spec("pcgym") is None, reason="PC-Gym is not installed")
def test_the_policy_starts_as_the_offset_free_mpc() -> None:
    import pcgym_cstr

    env = pcgym_cstr.make_env()
    law = pcgym_cstr.mpc.explicit()
    model = DDPG("YannPolicy", env, policy_kwargs={"problem": pcgym_cstr.mpc}, gamma=0.95)
    theta, _ = env.reset(seed=0)
    for _ in range(5):
        np.testing.assert_allclose(model.predict(theta)[0], law(theta), atol=1e-4)
        theta, reward, *_, info = env.step(law(theta))
        assert reward <= 0 <= info["pcgym_cost"]
