"""The explicit law is the MPC: the input of an online QP, everywhere; solving leaves no trace."""

import copy
import dataclasses
import pickle
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import general_problems as general
from benchmarks.suite import WRONG, Outcome, compare, examine, names
from benchmarks.suite_problems import SUITE, quietly
from fresh_process import run_python
from sample_problems import DOUBLE_INTEGRATOR, PROBLEMS, benchmark, box_points, small_mpc, solved
from sb3_yann import LinearModel, LinearMPC, SoftBounds, Terminal
from sb3_yann.control import ExplicitLimitError, PiecewiseAffine
from sparse_qp import online_answers, relative_error

FAMILIES = [(solved, name, 200, 0) for name in PROBLEMS]
FAMILIES += [(general.solved, name, 1000, 50) for name in general.PROBLEMS]


@pytest.mark.parametrize(("solved", "name", "count", "least"), FAMILIES)
def test_law_and_domain_are_those_of_an_online_qp(solved, name, count, least) -> None:
    mpc = solved(name)
    points = box_points(mpc, count, seed=1)
    inputs, feasible = online_answers(mpc, points)
    assert feasible.sum() > least
    np.testing.assert_array_equal(mpc.explicit().in_domain(points), feasible)
    assert relative_error(mpc, mpc.explicit()(points[feasible]), inputs) <= 1e-9


@pytest.mark.parametrize(
    ("name", "n_regions", "n_halfspaces"),
    [
        # Braniff & Tian's parameter counts decode to these numbers only: p regions and q half-
        # spaces in q(n+1) + p(q+1) + p^2 + ... = 15,188 (pendulum) and 5,320 (reactor).
        ("pendulum", 7, 32),
        ("reactor", 7, 56),
        # what the paper's text says literally; measured here
        ("reactor, predicted states bounded", 7, 79),
    ],
)
def test_partition_has_the_known_size(name: str, n_regions: int, n_halfspaces: int) -> None:
    law = solved(name).explicit()
    assert (law.n_regions, law.n_halfspaces) == (n_regions, n_halfspaces)


def test_published_benchmark_has_nine_regions_and_the_published_gains() -> None:
    # The double integrator of Bemporad, Morari, Dua & Pistikopoulos, The explicit linear quadratic
    # regulator for constrained systems, Automatica 38 (2002). The numbers are quoted second-hand,
    # to 4 decimals.
    law = benchmark().explicit()
    assert law.n_regions == 9
    table = {tuple(np.round([*g[0], o[0]], 4)) for g, o in zip(law.gains, law.offsets, strict=True)}
    published = {(-0.8166, -1.7499, 0), (-0.5528, -1.5364, 0.4308), (-0.5528, -1.5364, -0.4308)}
    assert table == {*published, (0, 0, 1), (0, 0, -1)}


@pytest.mark.slow
def test_a_fresh_process_gives_the_same_law_bit_for_bit(tmp_path: Any) -> None:
    path = tmp_path / "law.npz"
    code = (
        "import sys; from sb3_yann_envs import problems; "
        "problems.clipped_pendulum().explicit().save(sys.argv[1])"
    )
    run_python(code, path)
    law = solved("pendulum").explicit()
    assert type(law).load(path) == law


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda mpc: pickle.loads(pickle.dumps(mpc))])
def test_copies_of_a_problem_bring_the_solved_law(
    copied: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    twin = copied(solved("benchmark"))
    # Nothing is left to solve with.
    monkeypatch.setattr("sb3_yann.control.mpc.linear_mpc.solve_explicit", None)
    assert twin.explicit() == solved("benchmark").explicit()


@pytest.mark.parametrize(
    "changes",
    [
        {"model": LinearModel(DOUBLE_INTEGRATOR.A, DOUBLE_INTEGRATOR.B, 2.0)},
        {"Q": np.diag([1, 2])},
        {"R": [[2]]},
        {"horizon": 3},
        {"x_min": -4},
        {"u_max": 2},
        {"theta_min": -4},
        {"terminal": Terminal(np.eye(2))},
        {"terminal": Terminal(set=([[1, 1]], [3]))},
        {"gamma": 0.9},
        {"infeasible": "zero_input"},
    ],
)
def test_problems_that_differ_in_one_argument_are_not_equal(changes: dict[str, Any]) -> None:
    assert small_mpc(**changes) != small_mpc()


NOT_INSTALLED = """
import sys
for name in ("gurobipy", "quadprog", "cvxopt"):
    sys.modules[name] = None
from sb3_yann_envs import problems
problems.cstr().explicit()
print(problems.cstr().explicit("ppopt").n_regions)
"""


@pytest.mark.slow
def test_solving_needs_no_other_solver_and_prints_nothing() -> None:
    assert run_python(NOT_INSTALLED) == ("7\n", "")


def test_ppopt_is_left_as_it_was() -> None:
    from ppopt import solver
    from ppopt.solver_interface import solver_interface as inner

    shipped = solver.solve_lp_cvxopt, inner.solve_lp_cvxopt
    with pytest.raises(ExplicitLimitError):
        benchmark().explicit("ppopt", time_limit=1e-6)
    assert benchmark().explicit("ppopt").n_regions == 9
    assert (solver.solve_lp_cvxopt, inner.solve_lp_cvxopt) == shipped


def test_random_state_settings_of_numpy_and_the_folder_are_untouched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    python = random.getstate()
    legacy = np.random.get_state(legacy=False)  # noqa: NPY002
    settings = np.geterr(), np.get_printoptions()
    benchmark().explicit()
    assert random.getstate() == python
    np.testing.assert_equal(np.random.get_state(legacy=False), legacy)  # noqa: NPY002
    assert (np.geterr(), np.get_printoptions()) == settings
    assert list(tmp_path.iterdir()) == []


# One of each kind, what once failed first.
FEW = [
    *(
        "chain, dt 0.1, N 3, states within 2",
        "cart-pole, N 2, states within (0.9, 0.2, 2, 2), u 1.0",
    ),
    *("integrator, box (-2, 20), u 0.1, N 1", "integrator, box (-0.3, 100), u 0.02, N 3"),
    *(f"random, {kind}" for kind in ("states, 3", "invariant, 4", "soft, 1", "parts, 2")),
    *(
        "double integrator, invariant set, N 4",
        "quadruple tank, rates",
        "aircraft, pitch bounded, N 1",
    ),
]


def assert_right(outcome: Outcome) -> None:
    assert outcome.failure == ""
    assert outcome.holes == 0
    assert outcome.error <= WRONG
    assert outcome.points >= 10


@pytest.mark.parametrize("name", FEW)
def test_problems_of_each_kind_are_solved_and_right(name: str) -> None:
    assert_right(examine(name, 40))


@pytest.mark.nightly
@pytest.mark.parametrize("part", range(10))
def test_the_suite_is_solved_and_right(part: int) -> None:
    for name in names(large=False)[part::10]:
        if name not in FEW:
            assert_right(examine(name, 30))


@pytest.mark.parametrize("by", [1e-3, 1e-6])
def test_a_wrong_law_is_noticed(by: float) -> None:
    mpc = quietly(SUITE["double integrator, states within 5, N 2"])
    law = mpc.explicit()
    wrong = dataclasses.replace(law, gains=law.gains + by)
    assert compare(mpc, law, 60)[1] <= WRONG
    assert compare(mpc, wrong, 60)[1] > WRONG


SLIDER = LinearModel([[1, 0.2], [0, 0.95]], [[0.02], [0.2]], dt=0.2)
MIXER = LinearModel([[1.1, 0.2], [0, 0.9]], [[1, 0.3], [0.2, 1]], dt=1.0)
FAST = LinearModel([[1.7, 0.2], [0, 0.9]], [[1, 0.3], [0.2, 1]], dt=1.0)
PLANES = np.vstack([np.eye(2), -np.eye(2)])
AT_REST = Terminal(set=(PLANES, np.zeros(4)))
AT_A_POINT = Terminal(set=(PLANES, [0.3, 0.1, -0.3, -0.1]))
AT_A_TIP = Terminal(set=([[1, 0.5], [0, 1], [-1, -1]], [0, 0, 0]))
ON_A_LINE = Terminal(set=([[1, 2], [-1, -2]], [0.3, -0.3]))

ENDS: dict[str, tuple[LinearModel, Terminal, dict[str, Any]]] = {
    "at rest": (SLIDER, AT_REST, {}),
    "at rest, with no input left to choose": (SLIDER, AT_REST, {"horizon": 2}),
    "on a line": (SLIDER, ON_A_LINE, {}),
    "at the tip of three half-spaces": (SLIDER, AT_A_TIP, {}),
    "at a point, two inputs": (MIXER, AT_A_POINT, {"horizon": 3}),
    "at a point, soft bounds": (
        MIXER, AT_A_POINT, {"horizon": 3, "soft": SoftBounds(x=0.5, penalty=500.0)},
    ),
    "at rest, an unstable plant": (FAST, AT_REST, {"horizon": 4}),
}  # fmt: skip


@pytest.mark.parametrize("name", ENDS)
def test_both_laws_hold_a_final_state_as_a_program_with_all_states_does(name: str) -> None:
    model, terminal, changes = ENDS[name]
    given: dict[str, Any] = {"Q": np.diag([1, 0.5]), "R": 0.2 * np.eye(model.n_inputs)}
    given |= {"horizon": 6, "x_min": -3, "x_max": 4, "u_min": -1, "u_max": 1.5}
    mpc = LinearMPC(model, **{**given, **changes}, terminal=terminal)
    law = mpc.law()
    assert isinstance(law, PiecewiseAffine)
    points = box_points(mpc, 400, seed=5) * np.geomspace(0.02, 1, 400)[:, None]
    inputs, feasible = online_answers(mpc, points)
    assert feasible.sum() > 20
    np.testing.assert_array_equal(law.in_domain(points), feasible)
    assert relative_error(mpc, law(points[feasible]), inputs) < 1e-9
    assert relative_error(mpc, mpc.online()(points[feasible]), inputs) < 1e-9


def test_an_equality_that_leaves_theta_a_line_is_refused_with_what_to_do() -> None:
    mpc = LinearMPC(
        SLIDER, Q=np.eye(2), R=[[1]], horizon=1, x_min=-3, x_max=3, u_min=-1, u_max=1,
        terminal=AT_REST,
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"infeasible: .* lengthen the horizon.*online\(\)"):
        mpc.explicit()
