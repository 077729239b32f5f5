"""Online laws as C: the same answers, within bounded steps, without memory of the heap."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.cortex_m import emulate, missing
from deployed import Compiled, disturbed, needs_compiler, policy_of, self_test
from sb3_yann import LinearModel, LinearMPC, MixedBounds, RateLimits, SoftBounds, Terminal, export
from sb3_yann.deployment.controller import Controller, Status


def problem(n: int = 3, m: int = 1, horizon: int = 5, **changes: Any) -> LinearMPC:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(n, n))
    B = rng.normal(size=(n, m))
    A *= 0.98 / np.abs(np.linalg.eigvals(A)).max()
    model = LinearModel(A, B, 1.0, x_ss=rng.normal(size=n), u_ss=rng.normal(size=m) / 4)
    box = {"u_min": -1, "u_max": 1, "theta_min": -20, "theta_max": 20}
    weights = {"Q": np.eye(n), "R": 0.1 * np.eye(m), "horizon": horizon}
    return LinearMPC(model, **{**weights, **box, **changes})


CASES: dict[str, dict[str, Any]] = {
    "bounds of inputs": {},
    "bounds of states": {"x_min": -6, "x_max": 6},
    "rates": {"rate": RateLimits(-0.4, 0.4)},
    "mixed, zero input": {
        "m": 2, "x_max": 6, "mixed": MixedBounds(G=[[1, 1]], high=0.8), "infeasible": "zero_input",
    },
    "bounds that change": {"parametric_bounds": ["u_max"], "terminal": Terminal(set="invariant")},
    "soft bounds in a small unit, at the default penalty": {
        "x_min": -6, "x_max": 6, "soft": SoftBounds(x=0.1),
    },
    "soft and hard bounds in theta": {
        "x_min": -6, "x_max": 6, "parametric_bounds": ["u_max", "x_max[0]"],
        "mixed": MixedBounds(F=[[1, 1, 0]], G=[[1]], low=-4, high=4, soft=0.5),
    },
}  # fmt: skip


@needs_compiler
@pytest.mark.parametrize("name", CASES)
def test_code_and_controller_are_the_law(name: str, tmp_path: Path) -> None:
    mpc = problem(**CASES[name])
    mpc.law("online")
    law = mpc.online()
    built = Compiled(mpc, tmp_path)
    rng = np.random.default_rng(1)
    theta = rng.uniform(mpc.theta_min, mpc.theta_max, (1500, mpc.n_theta))
    inside = law.in_domain(mpc.units.to_deviations(theta))
    actions, found = built.at(theta)
    assert inside.sum() > 20
    off = np.abs(actions - law.plant_input(theta)) / mpc.u_half
    assert off[inside].max() < 1e-9 and off.max() < 1e-6
    assert "passed" in self_test(tmp_path).stdout
    np.testing.assert_array_equal((found & Status.OUTSIDE) == 0, inside)
    by_numpy = built.controller.evaluate(theta[:300])
    assert (np.abs(actions[:300] - by_numpy) / mpc.u_half).max() < 1e-6
    assert np.all(actions >= mpc.u_min) and np.all(actions <= mpc.u_max)


@needs_compiler
def test_the_self_test_passes_under_sanitizers_and_nothing_is_allocated(tmp_path: Path) -> None:
    mpc = problem(x_min=-6, x_max=6)
    policy = disturbed(mpc, law="online", max_correction=0.2)
    export(policy, tmp_path / "plant.c")
    assert "passed" in self_test(tmp_path).stdout
    text = (tmp_path / "plant.c").read_text()
    assert "malloc" not in text and "alloca(" not in text

    export(policy, tmp_path / "plant.npz")
    controller = Controller.load(tmp_path / "plant.npz")
    theta = np.random.default_rng(2).uniform(-5, 5, (50, 3))
    played = policy.predict(theta.astype(np.float32))[0]
    assert np.abs(controller.evaluate(theta.astype(np.float32)) - played).max() < 1e-4


@needs_compiler
@pytest.mark.nightly
def test_a_large_program_is_solved_as_by_daqp(tmp_path: Path) -> None:
    mpc = problem(12, 3, 20)
    mpc.law("online")
    built = Compiled(mpc, tmp_path)
    program = mpc.condensed()
    theta = np.random.default_rng(3).uniform(mpc.theta_min, mpc.theta_max, (10_000, mpc.n_theta))
    theta = mpc.theta_ss + np.linspace(0.02, 1, 10_000)[:, None] * (theta - mpc.theta_ss)
    wanted = np.array([program.solve(row - mpc.theta_ss)[:3] for row in theta]) + mpc.model.u_ss
    assert np.any(np.abs(wanted) > 1 - 1e-9, axis=1).sum() > 1000  # at bounds
    np.testing.assert_allclose(built.at(theta)[0], wanted, atol=1e-8, rtol=0)


pytestmark = pytest.mark.skipif(bool(missing()), reason=f"no {', '.join(missing())}")


@pytest.mark.parametrize(("name", "flash"), [("reactor", 32_000), ("reactor, shared", 32_000)])
def test_in_single_precision_it_fits_32_kb(name, flash, tmp_path):
    found = emulate(policy_of(name), tmp_path)
    assert found.wrong == 0
    assert found.flash < flash and found.memory < 2_000
    assert 0 < found.mean <= found.worst


def test_a_wrong_answer_is_seen(tmp_path, monkeypatch):
    from benchmarks import cortex_m

    kept = cortex_m.table

    def broken(kind, name, values, precision):
        return kept(kind, name, values + 1 if name == "answers" else values, precision)

    monkeypatch.setattr(cortex_m, "table", broken)
    assert emulate(policy_of("reactor"), tmp_path).wrong > 100
