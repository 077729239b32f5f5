"""Bad input is an error that names the argument; what arguments mean together is told."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from errors import Message, raises, told
from sample_problems import input_bounds_only, small_mpc
from sb3_yann import (
    LinearModel,
    LinearMPC,
    OutputBounds,
    RateLimits,
    SoftBounds,
    Terminal,
    Tracking,
)

NAN = np.nan
INF = np.inf
TURN = [[np.cos(1), np.sin(1), 0], [-np.sin(1), np.cos(1), 0], [0, 0, 0.5]]

BAD_MODELS: list[tuple[dict[str, Any], Message]] = [
    ({"A": [[1, 2, 3], [4, 5, 6]]}, r"A has shape \(2, 3\), expected a square matrix"),
    ({"A": np.zeros((0, 0))}, r"A has shape \(0, 0\), expected a square matrix"),
    ({"A": [[1, NAN], [0, 1]]}, "A holds NaN or infinite entries"),
    ({"A": [["a", 1], [0, 1]]}, TypeError("A = .* is not an array of real numbers")),
    ({"B": [[1], [2], [3]]}, r"B has shape \(3, 1\), expected \(2, m\)"),
    ({"B": np.zeros((2, 0))}, r"B has shape \(2, 0\): the model needs at least one"),
    ({"dt": 0}, "dt = 0 must be a finite number above 0"),
    ({"x_ss": [1]}, r"x_ss has shape \(1,\), expected \(2,\)"),
    ({"E": [[1]]}, r"E has shape \(1, 1\), expected \(2, d\)"),
    ({"d_ss": [1]}, r"d_ss = \[1\] is given, but there are no disturbances: pass E"),
]


BAD_DYNAMICS: list[tuple[dict[str, Any], Message]] = [
    ({"f": lambda x, u: [1, 2, 3]}, r"f returned the shape \(3,\). It is called as f\("),
    ({"f": lambda x, u: [1], "u_ss": [NAN]}, r"f returned the shape \(1,\). It is called as f\("),
    ({"f": lambda x, u: x * NAN}, r"f\(x_ss, u_ss\) holds NaN"),
    ({"f": lambda x, u: x + 1j}, TypeError(r"f\(x, u\) = .* is not an array of real")),
    ({"x_ss": [np.inf, 0]}, r"x_ss has .* expected a vector of finite numbers, or NaN"),
    ({"u_ss": 0.0}, r"u_ss has shape \(\) .* expected a vector"),
    ({"x_ss": []}, r"x_ss has shape \(0,\) .* finite numbers, .* one at least"),
    ({"f": lambda x, u: np.where(x < 0, NAN, u - x)}, "no finite value on one of its sides"),
    ({"f": lambda x, u: [1, 0]}, "is no steady state.*NaN to have them solved"),
    ({"f": 3}, TypeError("f = 3 must be a function")),
    ({"dt": 0}, "dt = 0 must be a finite number above 0"),
]


BAD_PROBLEMS: list[tuple[dict[str, Any], Message]] = [
    ({"Q": np.eye(3)}, r"Q has shape \(3, 3\), expected \(2, 2\)\. .* pass C\.T @ Q @ C"),
    ({"Q": [[1, NAN], [0, 1]]}, "Q holds NaN"),
    ({"Q": [[1, 2], [0, 1]]}, r"Q is not symmetric: .* Pass \(Q \+ Q.T\) / 2"),
    ({"Q": [[1, 2], [2, 1]]}, "Q must be positive semi-definite, .* is -1"),
    (
        {"Q": np.zeros((2, 2)), "R": [[0]]},
        "R must be positive definite, .* is 0, where .* Give every",
    ),
    ({"R": [[-1]]}, "R must be positive semi-definite, its smallest eigenvalue is -1"),
    ({"horizon": 0}, "horizon = 0 must be a whole number of at least 1"),
    ({"horizon": 2.5}, TypeError("horizon = 2.5 must be a whole number of steps")),
    ({"gamma": 0}, r"gamma = 0 must lie in \(0, 1\]"),
    ({"u_min": 2}, "u_min must lie below u_max, but entry 0 has u_min = 2 and u_max ="),
    ({"u_min": [-1, -1]}, r"u_min has shape \(2,\), expected \(1,\) or a single"),
    ({"u_max": NAN}, "u_max holds NaN: .* Use inf for 'no bound'"),
    ({"x_min": [0, 5]}, "x_min must lie below x_max, but entry 1 has x_min = 5"),
    ({"theta_min": 6}, "theta_min must lie below theta_max, but entry 0"),
    (
        {"infeasible": "mean"},
        r"infeasible = 'mean' must be one of \('nearest_region', 'zero_input'\)",
    ),
    ({"terminal": np.eye(2)}, TypeError("(?s)terminal = .* must be of the class Terminal")),
]

BAD_TERMINALS: list[tuple[dict[str, Any], Message]] = [
    ({"cost": np.eye(3)}, r"Terminal.cost has shape \(3, 3\), expected \(2,"),
    ({"cost": -np.eye(2)}, "Terminal.cost must be positive semi-definite"),
    ({"set": 5}, TypeError(r"Terminal.set must be a pair \(F, g\) of arrays .* got int")),
    ({"set": (np.eye(3), [1] * 3)}, r"Terminal.set F has shape \(3, 3\)"),
    ({"set": (np.eye(2), [1, INF])}, "Terminal.set g holds NaN or infinite"),
]


MODEL: dict[str, Any] = {"A": [[1, 1], [0, 1]], "B": [[0], [1]], "dt": 1.0}
DYNAMICS: dict[str, Any] = {"f": lambda x, u: -x + u, "x_ss": [0, 0], "u_ss": [0], "dt": 0.1}
MAKERS: list[tuple[Callable[..., Any], list[tuple[dict[str, Any], Message]]]] = [
    (lambda **changes: LinearModel.from_continuous(**{**MODEL, **changes}), BAD_MODELS),
    (lambda **changes: LinearModel.from_dynamics(**{**DYNAMICS, **changes}), BAD_DYNAMICS),
    (small_mpc, BAD_PROBLEMS),
    (lambda **changes: small_mpc(terminal=Terminal(**changes)), BAD_TERMINALS),
]


@pytest.mark.parametrize(
    ("make", "changes", "message"), [(make, *row) for make, bad in MAKERS for row in bad]
)
def test_a_bad_argument_is_named(
    make: Callable[..., Any], changes: dict[str, Any], message: Message
) -> None:
    with raises(message):
        make(**changes)


@pytest.mark.parametrize(
    ("A", "B"),
    [
        ([[1.2, 0], [0, 0.5]], [[0], [1]]),
        (np.eye(2), [[1], [0]]),
        (TURN, [[0], [0], [1]]),
        ([[3]], [[0]]),
    ],
    ids=["unstable", "two integrators, one input", "on the unit circle", "no input at all"],
)
def test_an_unstable_mode_out_of_reach_is_named(A: Any, B: Any) -> None:
    model = LinearModel(A, B, 1.0)
    with pytest.raises(ValueError, match=r"no input reaches: eigenvalue .* Remove the mode from"):
        LinearMPC(model, Q=np.eye(len(A)), R=[[1]], horizon=2)


@pytest.mark.parametrize(
    ("A", "Q", "gamma"),
    [
        (np.diag([1, 0.5]), [0, 1], 1.0),
        (np.diag([-1, 0.5]), [0, 1], 1.0),
        (TURN, [0, 0, 1], 1.0),
        (np.diag([1, 0.5]) / np.sqrt(0.9), [0, 1], 0.9),
        ([[1, 1], [0, 1]], [0, 0], 1.0),
    ],
    ids=["integrator", "alternating", "oscillator", "after the discount", "no weight at all"],
)
def test_a_mode_on_the_unit_circle_without_weight_is_an_error(
    A: Any, Q: list[float], gamma: float
) -> None:
    model = LinearModel(A, np.ones((len(A), 1)), 1.0)
    with pytest.raises(ValueError, match=r"on the unit circle carries no weight in Q. Give it a"):
        LinearMPC(model, Q=np.diag(Q), R=[[1]], horizon=2, gamma=gamma)


@pytest.mark.parametrize("size", [1e20, 1e50])
def test_a_model_that_is_badly_scaled_is_called_that(size: float) -> None:
    model = LinearModel([[0.5, size], [0, 0.5]], [[0], [1]], 1.0)
    words = rf"badly scaled, .* from 0\.5 to {size:.2g} in".replace("+", ".")
    with pytest.raises(ValueError, match=words):
        LinearMPC(model, Q=np.eye(2), R=[[1]], horizon=2)
    fast = LinearModel.from_continuous([[0, 1], [1, 0]], [[0], [1]], dt=100.0)  # e to the 100
    with pytest.raises(ValueError, match=r"grows 2.7e\+43 times .* Is dt in the unit"):
        LinearMPC(fast, Q=np.eye(2), R=[[1]], horizon=2)


def test_a_terminal_cost_stands_in_for_the_riccati_solution() -> None:
    mpc = small_mpc(LinearModel(np.eye(2), [[1], [0]], 1.0), terminal=Terminal(np.eye(2)))
    np.testing.assert_array_equal(mpc.terminal.cost, np.eye(2))


def test_a_smaller_discount_stands_in_for_an_input_that_does_not_reach() -> None:
    model = LinearModel([[1.02, 0], [0, 0.5]], [[0], [1]], 1.0)
    assert input_bounds_only(model, gamma=0.9).explicit().in_domain([1, 1])


@pytest.mark.parametrize(
    "changes",
    [
        {"terminal": Terminal(set=([[1, 0], [-1, 0]], [-1, -1]))},  # x <= -1 and x >= 1
        {"theta_min": [50, 50], "theta_max": [60, 60]},  # out of the inputs' reach
    ],
)
def test_an_infeasible_problem_is_a_value_error(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"infeasible: no theta in its box .* Widen x_min/x_max"):
        small_mpc(**changes).explicit()


def test_an_unbounded_box_is_a_value_error() -> None:
    names = {"state_names": ["place", "speed"], "input_names": ["force"], "x_ss": [12, 0]}
    with pytest.warns(UserWarning, match=r"x_ss is given without u_ss.* rests .* u_ss = \[0.0\]"):
        cart = LinearModel([[1, 1], [0, 1]], [[0], [1]], 1, **names)
    for changes, ends in (
        ({"x_min": None, "x_max": None}, "place from -inf to inf, speed from -inf to inf"),
        ({"x_min": [-1, -INF]}, "speed from -inf to 20"),
        ({"theta_max": INF}, "place from -5 to inf, speed from -5 to inf"),
    ):
        with pytest.raises(ValueError, match=f"bounded box of theta, not {ends}. Pass finite the"):
            small_mpc(cart, **{"x_max": 20} | changes).explicit()


def test_bad_discount_of_the_critic_is_named() -> None:
    mpc = small_mpc()
    for gamma, message in (
        (0, r"gamma = 0 must lie in \(0, 1\]"),
        ("high", TypeError("gamma = 'high' must be a number")),
    ):
        for matrix in (mpc.value_matrix, mpc.state_action_terms):
            with raises(message):
                matrix(gamma)
    with pytest.raises(ValueError, match="samples = 0 must be a whole number"):
        mpc.report(samples=0)
    assert mpc._laws == {}  # nothing was solved for it


def test_a_model_whose_inputs_do_nothing_is_refused() -> None:
    model = LinearModel([[0.7, 0.2], [0, 0.9]], np.zeros((2, 2)), dt=0.5)
    with pytest.raises(ValueError, match=r"B of the model is zero.*nothing to control"):
        LinearMPC(model, Q=np.eye(2), R=np.eye(2), horizon=3, x_min=-1, x_max=1, u_min=-1, u_max=1)


WEIGHTS: dict[str, Any] = {"Q": np.eye(2), "R": [[1]], "horizon": 1, "u_min": -1, "u_max": 1}
PLANT = LinearModel([[0.9, 0.1], [0.0, 0.8]], [[0], [1]], 1)


def said(**given: Any) -> list[str]:
    """Return the warnings about a problem."""
    values = WEIGHTS | {"theta_min": -5, "theta_max": 5, "model": PLANT} | given
    return told(lambda: LinearMPC(**values))


def test_a_soft_bound_reaches_half_its_width_beyond_and_a_hard_one_nowhere() -> None:
    mpc = LinearMPC(
        PLANT, **WEIGHTS, x_min=[-1, -4], x_max=[3, 4], soft=SoftBounds([1, 0], penalty=10)
    )
    assert mpc.theta_min.tolist() == [-3, -4] and mpc.theta_max.tolist() == [5, 4]
    one_sided = {"x_min": [-1, -4], "x_max": [np.inf, 4], "theta_max": [9, 4]}
    (note,) = said(**one_sided, theta_min=None, soft=SoftBounds([1, 0], penalty=10))
    assert "theta_min = -1 and theta_max = 9 do not exceed them" in note


@pytest.mark.parametrize(
    ("r_min", "r_max", "many"), [(15, 30, "none"), (9, 30, None), (-10, 31, "few"), (9, None, None)]
)
def test_set_points_that_the_states_bounds_leave_out_are_named(r_min, r_max, many) -> None:
    plant = LinearModel([[0.9]], [[0.5]], dt=1)
    bounds = {"Q": [[1]], "x_min": -10, "x_max": 10, "u_min": -5, "u_max": 5}
    box = {"theta_min": None, "theta_max": None}
    notes = said(model=plant, **bounds, **box, tracking=Tracking([0], r_min, r_max))
    found = [note for note in notes if "can be reached" in note]
    assert len(found) == bool(many)
    words = "r[0] between -10 and 10", f"{r_min} to {r_max}: {many} can be"
    assert all(each in note for note in found for each in words)
    by_box = {"theta_min": -10, "theta_max": 10, "x_min": None, "x_max": None}
    notes = said(model=plant, **{**bounds, **by_box}, tracking=Tracking([0], r_min, r_max))
    assert found == [note for note in notes if "can be reached" in note]


def test_softness_of_a_single_number_is_for_all_that_have_a_bound() -> None:
    mpc = LinearMPC(
        PLANT, **WEIGHTS, x_min=[-1, -np.inf], theta_min=-5, theta_max=5,
        outputs=OutputBounds([[1, 0], [0, 1]], y_max=[np.inf, 2]), soft=SoftBounds(2, 3, 10),
    )  # fmt: skip
    assert mpc.soft.x.tolist() == [2, 0] and mpc.soft.y.tolist() == [0, 3]
    for soft, message in (
        (SoftBounds([1, 1], penalty=10), r"softens entry 1, which has no bound: make it 0"),
        (SoftBounds(y=1, penalty=10), "but there is no bound to soften: pass y_min or y_max"),
    ):
        with pytest.raises(ValueError, match=message):
            LinearMPC(PLANT, **WEIGHTS, x_min=[-1, -np.inf], theta_min=-5, theta_max=5, soft=soft)
    with pytest.raises(ValueError, match=r"nothing is soft"):
        LinearMPC(PLANT, **WEIGHTS, x_min=-1, theta_min=-5, theta_max=5, soft=SoftBounds(0, 0, 5))
    assert SoftBounds(1).penalty is None  # the problem chooses it
    with pytest.raises(ValueError, match="no entry may be negative"):
        SoftBounds([0, -1e-9], penalty=1)
    assert SoftBounds().penalty == 0.0


def test_a_soft_bound_that_the_box_does_not_exceed_is_reported() -> None:
    bounds = {"x_min": [-1, -2], "x_max": [1, 2], "soft": SoftBounds([1, 0], penalty=10)}
    (note,) = said(**bounds, theta_min=[-1, -2], theta_max=[1, 2])
    assert "softens the bounds -1 to 1 of x[0], but theta_min = -1 and theta_max = 1" in note
    for box in ({"theta_min": [-1.1, -2], "theta_max": [1, 2]},
                {"theta_min": [-1, -2], "theta_max": [1.1, 2]}):  # fmt: skip
        assert said(**bounds, **box) == []


def test_a_rate_must_let_the_input_rest() -> None:
    for low, high in ((0.1, 1), (-1, -0.1)):
        with pytest.raises(ValueError, match=r"make u\[0\] change in every sample"):
            RateLimits(low, high)
