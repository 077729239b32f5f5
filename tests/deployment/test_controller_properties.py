"""What holds for the exported controller of any problem, with any weights and readings."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from deployed import disturbed
from random_problems import examples, problems
from sb3_yann import Checks, Controller, LinearMPC, export

OPTIONS = st.sampled_from([
    {"networks": "per_region", "max_correction": 0.2},
    {"networks": "shared"},
    {"networks": "shared", "net_arch": [5], "activation_fn": th.nn.ELU},
])  # fmt: skip


def exported(given: Any, **options: Any) -> Controller:
    with tempfile.TemporaryDirectory() as folder:
        export(given, Path(folder) / "plant.npz", **options)
        return Controller.load(Path(folder) / "plant.npz")


@examples(15)
@given(problems(), st.data(), OPTIONS, st.sampled_from([0.3, 1e3, 1e30]), st.booleans())
def test_every_reading_has_an_output_within_its_bounds(
    mpc: LinearMPC, data: Any, options: dict, size: float, wide: bool
) -> None:
    policy = disturbed(mpc, size=size, **options)
    controller = exported(policy, checks=Checks(hold=2, recover=2, transfer=2))
    number = st.floats(width=64 if wide else 32)
    rows = st.lists(number, min_size=mpc.n_theta, max_size=mpc.n_theta)
    seen = np.array(data.draw(st.lists(rows, min_size=2, max_size=6)))
    low, high = (
        each.astype(np.float64) for each in (policy.action_space.low, policy.action_space.high)
    )
    room = 1e-12 * (high - low)
    u = controller.evaluate(seen)
    alone = np.array([controller.evaluate(each) for each in seen])
    steps = np.array([controller(each) for each in [*seen, *seen]])
    for each in (u, alone, steps):
        assert np.all((low - room <= each) & (each <= high + room))
    if size < 1:
        assert np.all(np.abs(alone - u) <= room)
