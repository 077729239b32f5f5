"""The table of PC-Gym's plants: its cells by hand, and what the controllers do, if it is there."""

import importlib.util

import numpy as np
import pytest

from experiments import pcgym
from experiments.runner import Outcome, Run

PLANT = next(iter(pcgym.PLANTS))
needs_pcgym = pytest.mark.skipif(
    importlib.util.find_spec("pcgym") is None, reason="PC-Gym is not installed"
)


def outcome(*costs: list[float], steps: tuple[int, ...] = (0,)) -> Outcome:
    none = np.zeros(0)
    tests = np.array(costs)
    extra = {"stage_costs": 2 * tests, "ms": np.full(len(tests), 0.5)}
    return Outcome(np.array(steps), tests, np.zeros_like(tests), none, none, none, extra)


OUTCOMES = {
    Run(PLANT, pcgym.OFFSET_FREE, 0, 0): outcome([10.0, 30.0]),
    Run(PLANT, pcgym.OURS, 40, 50): outcome([9.0, 30.2], steps=(5950,)),
    Run(PLANT, pcgym.OURS, 41, 50): outcome([10.0, 30.0], steps=(5950,)),
    Run(PLANT, "PPO", 40, 50): outcome([40.0, 40.0], [20.0, 30.0], steps=(5950, 50_000)),
}


def test_rows_are_medians_against_the_offset_free_mpc(tmp_path):
    offset_free, ours, late = pcgym.rows(OUTCOMES)
    assert offset_free == (PLANT, "offset-free MPC", "", "+0.00", "+0.00", "0.50")
    assert ours[2:5] == ("5,950", "-1.00 (-2.00 to +0.00)", "+1.00")
    assert late[2:5] == ("50,000", "+25.00", "+50.00")
    assert len(offset_free) == len(pcgym.HEADER)
    page = tmp_path / "environments.md"
    page.write_text(f"before\n{pcgym.BEGIN}old\n{pcgym.END}after\n", encoding="utf-8")
    assert pcgym.write_report(OUTCOMES, tmp_path) == [page]
    assert "-1.00 (-2.00 to +0.00); +1.00 |" in page.read_text(encoding="utf-8")
    assert pcgym.write_report({}, tmp_path) == pcgym.rows({}) == []


@needs_pcgym
@pytest.mark.parametrize("name", pcgym.HORIZONS)
def test_controllers_are_played_on_the_plant_they_know(name):
    case = pcgym.Case(name)
    other = pcgym.Case(name, offset_free=True)
    env = other.env()
    size = case.plant.observation_space.shape[0]
    theta, _ = env.reset(seed=5)
    assert theta.shape == (other.mpc.n_theta,)
    law = case.mpc.explicit().plant_input
    nmpc = pcgym.NonlinearMPC(case)
    for act in (law, nmpc):
        u = act(theta[None, :size])
        assert np.all(u >= case.mpc.u_min - 1e-9) and np.all(u <= case.mpc.u_max + 1e-9)
