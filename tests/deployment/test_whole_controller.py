"""A controller is exported with its estimator: outputs in, inputs out, in every format."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from deployed import Compiled, disturbed, error, needs_compiler, policy_of, self_test, with_faults
from sb3_yann import (
    Checks,
    Controller,
    DisturbanceBounds,
    LinearCost,
    LinearModel,
    LinearMPC,
    RateLimits,
    StateEstimator,
    Tracking,
    export,
    offset_free,
    with_extra,
)
from sb3_yann._validation import Array
from sb3_yann.deployment.controller import MODES, Status
from sb3_yann.policy import YannPolicy
from structured_text import FunctionBlock

A = np.array([[0.9, 0.3, 0.0], [0.0, 0.7, 0.1], [0.05, 0.0, 0.8]])
B = np.array([[0.0, 0.1], [0.5, 0.0], [0.0, 0.4]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
X_SS = np.array([50.0, 2.0, 300.0])
U_SS = np.array([3.0, 7.0])
LOAD = np.array([[0.0], [0.3], [0.1]])
BEGIN = np.array([52.0, 2.0, 297.0])


@cache
def problem(rates: bool = False, extra: bool = False) -> tuple[LinearMPC, StateEstimator]:
    """Return an offset-free MPC of three states, two of them shown, with a measured load.

    An extra signal, if there is one, lies between 0 and 1.
    """
    model = LinearModel(A, B, 1.0, X_SS, U_SS, E=LOAD, d_ss=[1.0], C=C)
    mpc = LinearMPC(
        model,
        Q=np.eye(3),
        R=0.1 * np.eye(2),
        horizon=1 if rates else 2,
        u_min=U_SS - 2,
        u_max=U_SS + 2,
        theta_min=X_SS - 20,
        theta_max=X_SS + 20,
        tracking=Tracking(C, [45, 295], [55, 305]),
        disturbances=DisturbanceBounds(0.0, 2.0),
        rate=RateLimits(-0.5, 0.5) if rates else None,
    )
    return offset_free(with_extra(mpc, 0, 1) if extra else mpc)


@cache
def policy(rates: bool = False, extra: bool = False) -> YannPolicy:
    mpc = problem(rates, extra)[0]
    mpc.explicit()
    return disturbed(mpc, 0.05, networks="shared")


def noisy_steps(count: int) -> list[tuple[Any, ...]]:
    """Return noise, load, reference, elapsed, request, manual, and whether it starts anew."""
    rng = np.random.default_rng(5)
    found = []
    for k in range(count):
        noise = 0.05 * rng.normal(size=2)
        if rng.random() < 0.1:
            noise[rng.integers(2)] = rng.choice([np.nan, np.inf, 1e9])
        if k % 7:
            noise[1] = np.nan  # read now and then
        reference = np.array([[52.0, 302.0], [47.0, 299.0]])[k // 100 % 2]
        request = int(rng.choice([0, 1, 2], p=[0.96, 0.02, 0.02]))
        manual = U_SS + rng.uniform(-1, 1, 2) if rng.random() < 0.3 else None
        load = np.nan if rng.random() < 0.02 else 1.0 + 0.5 * (k // 150 % 2)
        anew = k in (300, 601)
        found.append((noise, load, reference, 1.0 + rng.random(), request, manual, anew))
    return found


def checks_of(size: int) -> Checks:
    wide = np.full(size, 1e3)
    missing = [2, 8, *[0] * (size - 2)]
    return Checks(-wide, wide, missing=missing, hold=3, recover=4, late_after=1.95)


CHECKS = checks_of(5)
WITH_EXTRA = checks_of(6)


def loop(
    controller: Any, steps: list[tuple[Any, ...]], extra: bool = False
) -> tuple[Array, list[tuple[int, int]]]:
    """Return inputs (T, 2), and status and mode, of a plant that the model does not quite know."""
    x = BEGIN
    u = U_SS
    inputs = []
    said = []
    for k, (noise, load, reference, elapsed, request, manual, anew) in enumerate(steps):
        if anew:
            controller.begin()
        shown = np.array([*(C @ x + noise), *reference, load, *[np.sin(k) ** 2] * extra])
        u, status, mode = controller.step(shown, elapsed, request, u if anew else manual)
        inputs.append(u)
        said.append((status, mode))
        load = 1.0 if np.isnan(load) else load
        x = X_SS + A @ (x - X_SS) + 1.05 * B @ (u - U_SS) + LOAD[:, 0] * (load - 1) + [0.05, 0, 0.1]
    return np.array(inputs), said


class InPython:
    def __init__(self, controller: Controller) -> None:
        self.controller = controller

    def begin(self) -> None:
        self.controller.reset()

    def step(self, obs: Array, elapsed: float, request: int, manual: Any) -> Any:
        self.controller.request = MODES[request]
        u = self.controller(obs, elapsed, manual)
        return u, int(self.controller.status), MODES.index(self.controller.mode)


class InC:
    """Of modes, which C does not return, it says -1."""

    def __init__(self, given: Any, folder: Path, **options: Any) -> None:
        self.compiled = Compiled(given, folder, **options)
        self.controller = self.compiled.controller
        self.compiled.begin()

    def begin(self) -> None:
        self.compiled.begin()

    def step(self, obs: Array, elapsed: float, request: int, manual: Any) -> Any:
        u, status = self.compiled.step(obs, elapsed, request, manual)
        return u, status, -1


class InStructuredText:
    def __init__(self, given: Any, folder: Path, **options: Any) -> None:
        export(given, folder / "plant.npz", **options)
        export(given, folder / "plant.st", **options)
        self.controller = Controller.load(folder / "plant.npz")
        self.block = FunctionBlock((folder / "plant.st").read_text())

    def begin(self) -> None:
        self.block.vars["started"] = False

    def step(self, obs: Array, elapsed: float, request: int, manual: Any) -> Any:
        given = [0.0] * len(self.controller.action_names) if manual is None else list(manual)
        command, status, mode = self.block.step(
            obs=list(obs), elapsed=elapsed, request=request, manual=given,
            has_manual=manual is not None,
        )  # fmt: skip
        return np.array(command), status, mode


IN_C = pytest.param(InC, marks=needs_compiler)


@pytest.mark.parametrize(
    "name", ["reactor", "references and rates", "mixed observations", "two inputs, zero input"]
)
@pytest.mark.parametrize("form", [IN_C, InStructuredText])
def test_steps_with_faults_are_the_controllers(form, name, tmp_path) -> None:
    checks, steps = with_faults(policy_of(name), 500)
    coded = form(policy_of(name), tmp_path, checks=checks)
    python = InPython(coded.controller)
    met = Status(0)
    modes = set()
    for k, (seen, elapsed, request, manual) in enumerate(steps):
        wanted, status, mode = python.step(seen, elapsed, request, manual)
        found, *said = coded.step(seen, elapsed, request, manual)
        assert error(found, wanted, coded.controller) < 1e-12, k
        assert said in ([status, mode], [status, -1]), k
        met |= Status(status)
        modes.add(mode)
    rest = coded.controller.data["obs_rest"]
    held, status, _ = coded.step(rest, 1.0, 2, np.full(len(found), np.nan))
    assert status & Status.NOT_FINITE and np.all(np.isfinite(held))
    assert modes == {0, 1, 2}
    assert Status.OUT_OF_RANGE | Status.FROZEN | Status.LATE | Status.NOT_FINITE in met


@pytest.mark.parametrize(
    ("form", "kind", "rates", "extra"),
    [
        *(
            pytest.param(InC, *case, marks=needs_compiler)
            for case in [
                ("problem", False, False),
                ("problem", True, False),
                ("online", False, False),
                ("policy", False, False),
                ("policy", True, False),
                ("policy", False, True),
            ]
        ),
        (InStructuredText, "policy", False, False),
        (InStructuredText, "policy", True, False),
        (InStructuredText, "policy", False, True),
    ],
)
def test_a_closed_loop_is_that_of_python(form, kind, rates, extra, tmp_path) -> None:
    given, observer = problem(rates, extra)
    if kind == "online":
        given, observer = problem.__wrapped__()
        given.law("online")
    elif kind == "policy":
        given = policy(rates, extra)
    coded = form(given, tmp_path, estimator=observer, checks=WITH_EXTRA if extra else CHECKS)
    steps = noisy_steps(1000 if form is InC else 400)
    wanted, said = loop(InPython(coded.controller), steps, extra)
    found, own = loop(coded, steps, extra)
    np.testing.assert_allclose(found, wanted, atol=4e-10, rtol=0)  # of a range of 4
    assert [each[0] for each in own] == [each[0] for each in said]
    assert form is InC or own == said
    if form is not InC:
        return
    met = Status(0)
    for status, _ in said:
        met |= Status(status)
    assert met >= Status.NOT_FINITE | Status.OUT_OF_RANGE | Status.LATE
    assert {mode for _, mode in said} == {0, 1, 2}
    assert sum(mode == 0 for _, mode in said) > 200  # a value of every seventh step is no fault


def test_extra_signals_of_a_policy_are_beside_those_of_its_estimator(tmp_path) -> None:
    mpc, observer = problem()
    shown = spaces.Box(np.append(mpc.theta_min, 0), np.append(mpc.theta_max, 1), dtype=np.float64)
    seen = disturbed(mpc, 0.05, networks="shared", extra=1, observation_space=shown)
    loops = []
    for given, estimator in ((seen, observer), (policy(extra=True), problem(extra=True)[1])):
        export(given, tmp_path / "plant.npz", estimator=estimator)
        python = InPython(Controller.load(tmp_path / "plant.npz"))
        loops.append(loop(python, noisy_steps(100), True)[0])
    np.testing.assert_allclose(*loops, atol=1e-6)


@needs_compiler
@pytest.mark.parametrize("precision", ["double", "float"])
def test_the_self_test_runs_a_closed_loop_and_can_fail(precision, tmp_path) -> None:
    # A name that begins like tables of the code.
    export(policy(), tmp_path / "est.c", estimator=problem()[1], precision=precision)
    code = tmp_path / "est.c"
    assert self_test(tmp_path, "est").returncode == 0
    text = code.read_text()
    for old, factor in (("est_gain[j][i] * x[i]", "0.9"), ("state->output[i] * input", "1.01")):
        assert old in text
        code.write_text(text.replace(old, f"(real){factor} * {old}"))
        assert self_test(tmp_path, "est").returncode == 1


def settled(controller: Controller, reference: Array, steps: int = 300) -> tuple[Array, Array]:
    """Return outputs (T, 2) and inputs of a plant with loads that nothing measures."""
    x = BEGIN
    u = []
    shown = []
    for _ in range(steps):
        shown.append(C @ x)
        u.append(controller([*shown[-1], *reference, 1.0]))
        x = X_SS + A @ (x - X_SS) + 1.1 * B @ (u[-1] - U_SS) + [0.05, 0.0, 0.1]
    return np.array(shown), np.array(u)


def test_outputs_settle_without_offset_by_the_exported_controller_alone(tmp_path) -> None:
    mpc, observer = problem()
    export(mpc, tmp_path / "plant.npz", estimator=observer)
    controller = Controller.load(tmp_path / "plant.npz")
    assert controller.note == ""
    assert controller.obs_names[:4] == ("x[0]", "x[2]", "r[0]", "r[1]")
    shown, _ = settled(controller, np.array([51.0, 301.0]))
    np.testing.assert_allclose(shown[-1], [51.0, 301.0], atol=1e-4)


def test_it_is_the_estimator_and_the_law_of_the_wrapped_env(tmp_path) -> None:
    mpc, observer = problem()
    export(mpc, tmp_path / "plant.npz", estimator=observer)
    shown, inputs = settled(Controller.load(tmp_path / "plant.npz"), np.array([51.0, 301.0]), 50)
    low = mpc.disturbances.d_min[1:]
    high = mpc.disturbances.d_max[1:]
    law = mpc.explicit()
    for k, y in enumerate(shown):
        y = y - C @ X_SS
        found = observer.update(y, inputs[k - 1] - U_SS, [0.0]) if k else observer.reset(y)
        theta = [*(found[0] + X_SS), 51.0, 301.0, 1.0, *np.clip(found[1], low, high)]
        np.testing.assert_allclose(inputs[k], law.plant_input(np.array(theta)), atol=1e-9)


def test_networks_see_an_extra_signal_beside_the_estimates(tmp_path) -> None:
    given = policy(extra=True)
    observer = problem(extra=True)[1]
    export(given, tmp_path / "plant.npz", estimator=observer)
    controller = Controller.load(tmp_path / "plant.npz")
    assert controller.obs_names == ("x[0]", "x[2]", "r[0]", "r[1]", "d[0]", "d[1]")
    y = np.array([50.5, 299.0])
    inputs = []
    for feed in (0.0, 1.0):
        controller.reset()
        inputs.append(controller([*y, 51.0, 301.0, 1.0, feed]))
        x_hat, d_hat = observer.reset(y - C @ X_SS)
        theta = np.array([*(x_hat + X_SS), 51.0, 301.0, 1.0, feed, *d_hat])
        np.testing.assert_allclose(inputs[-1], given.predict(theta)[0], atol=1e-5)
    assert np.abs(inputs[1] - inputs[0]).max() > 1e-3


def test_a_start_goes_on_from_the_plants_present_input(tmp_path) -> None:
    mpc, observer = problem()
    export(mpc, tmp_path / "plant.npz", estimator=observer, checks=Checks(transfer=20))
    controller = Controller.load(tmp_path / "plant.npz")
    # a load that nothing measures
    u = np.array([3.1, 6.6])
    d = np.array([0.3, -0.2])
    deviation = np.linalg.solve(np.eye(3) - A, B @ (u - U_SS) + np.linalg.pinv(C) @ d)
    y = C @ (X_SS + deviation)
    inputs = [controller([*y, *y, 1.0], manual=u)]
    np.testing.assert_allclose(inputs[0], u, atol=1e-12)
    np.testing.assert_allclose(controller._estimate, [*(X_SS + deviation), *d], atol=1e-9)
    for _ in range(50):  # the plant rests there, and that is where it is asked to be
        inputs.append(controller([*y, *y, 1.0]))
    np.testing.assert_allclose(inputs, np.tile(u, (51, 1)), atol=1e-6)


@pytest.mark.parametrize("form", [IN_C, InStructuredText])
def test_the_first_step_keeps_the_rate_beside_a_price(form, tmp_path) -> None:
    given, _ = problem(rates=True)
    model = LinearModel(A, B, 1.0, X_SS, U_SS, C=C)
    parts = {"model": model, "tracking": None, "disturbances": None, "price": LinearCost(u=[9, 0])}
    mpc = replace(given, **parts, terminal=None)
    coded = form(mpc, tmp_path, estimator=StateEstimator(model))
    y = C @ X_SS
    wanted = coded.controller(y)
    np.testing.assert_allclose(wanted[0], U_SS[0] - 0.5, atol=1e-12)
    np.testing.assert_allclose(coded.step(y, 1.0, 0, None)[0], wanted, atol=1e-12)


def test_what_estimates_is_refused_where_it_does_not_fit(tmp_path) -> None:
    mpc, observer = problem()
    path = tmp_path / "plant.npz"
    other = StateEstimator(LinearModel(A, 2 * B, 1.0, X_SS, U_SS, C=C))
    plain = LinearMPC(
        LinearModel(A, B, 1.0, X_SS, U_SS, C=C), Q=np.eye(3), R=np.eye(2), horizon=1,
        theta_min=X_SS - 20, theta_max=X_SS + 20, u_min=U_SS - 2, u_max=U_SS + 2,
    )  # fmt: skip
    for given, options, message in (
        (mpc, {"estimator": other}, "of another model than the problem"),
        (mpc, {"estimator": "me"}, "must be a StateEstimator"),
        (mpc.explicit(), {"estimator": observer}, "do not say where"),
        (mpc, {}, "estimator=observer"),
        (plain, {}, "The states are estimated.* estimator=observer"),
        (mpc, {"estimator": observer, "format": "onnx"}, "no memory"),
        (mpc, {"estimator": observer, "checks": Checks(missing=[1, 2])}, "one for each of the 5"),
    ):
        with pytest.raises(ValueError, match=message):
            export(given, path, **options)
    assert not list(tmp_path.iterdir())


def test_limits_and_a_present_input_in_other_units_are_told(tmp_path) -> None:
    mpc, observer = problem()
    swapped = Checks([290, 40, 60, 290, 0], [310, 60, 70, 310, 2])
    with pytest.warns(UserWarning, match="leave out the operating point") as told:
        export(mpc, tmp_path / "plant.npz", estimator=observer, checks=swapped)
    named = [str(each.message).split(" leave")[0][-4:] for each in told]
    assert named == ["x[0]", "x[2]", "r[0]"]
    controller = Controller.load(tmp_path / "plant.npz")
    with pytest.warns(UserWarning, match=r"300 of u\[0\], is far beyond its bounds, 1 to 5"):
        controller([50, 300, 50, 300, 1], manual=[300, 7])


@pytest.mark.parametrize("x_ss", [0.0, 1e5])
def test_slow_readings_are_not_missing_and_float_is_refused_far_from_zero(x_ss, tmp_path) -> None:
    model = LinearModel([[0.9, 0.05], [0, 0.8]], [[0.1], [0.3]], 1, x_ss=[x_ss, 3], u_ss=[0])
    box = {"theta_min": [x_ss - 0.5, 2], "theta_max": [x_ss + 0.5, 4], "u_min": -1, "u_max": 1}
    tracking = Tracking([0], x_ss - 0.4, x_ss + 0.4)
    mpc = LinearMPC(model, Q=np.eye(2), R=[[0.1]], horizon=3, tracking=tracking, **box)
    mpc, observer = offset_free(mpc, every=[1, 20])
    export(mpc, tmp_path / "slow.npz", estimator=observer)
    assert Controller.load(tmp_path / "slow.npz").data["missing"].tolist() == [0, 19, 0]
    if x_ss:
        with pytest.raises(ValueError, match="Pass precision='double'"):
            export(mpc, tmp_path / "slow.c", estimator=observer, precision="float")
