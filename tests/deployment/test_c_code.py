"""The C code of an export is the controller, step by step, for compilers at their strictest."""

import os
import re
import shutil
import subprocess

import numpy as np
import pytest

from deployed import (
    CASES,
    COMPILERS,
    STRICT,
    Compiled,
    error,
    needs_compiler,
    observations,
    policy_of,
    self_test,
)
from sample_laws import solved
from sb3_yann import Checks, Controller, LinearModel, LinearMPC, export
from sb3_yann.deployment.code import insensitive
from sb3_yann.deployment.controller import Status

pytestmark = needs_compiler


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("name", CASES)
def test_double_is_the_controller(name, compiler, tmp_path):
    policy = policy_of(name)
    compiled = Compiled(policy, tmp_path, compiler=compiler)
    obs = observations(policy, 3_000)
    controller = compiled.controller
    # On a facet of a law whose networks jump there, rounding chooses.
    kept = insensitive(controller, obs, "double")
    assert len(kept) > 0.55 * len(obs)
    actions, found = compiled.at(kept)
    assert error(actions, controller.evaluate(kept), controller) < 1e-12
    by_law, _ = compiled.at(kept, law=True)
    assert error(by_law, controller.evaluate(kept, networks=False), controller) < 1e-12
    assert np.array_equal((found & int(Status.OUTSIDE)) > 0, ~controller.in_domain(kept))


@pytest.mark.parametrize("name", CASES)
def test_float_is_the_controller_where_it_is_steady(name, tmp_path):
    policy = policy_of(name)
    compiled = Compiled(policy, tmp_path, "float")
    obs = observations(policy, 3_000).astype(np.float32).astype(np.float64)
    kept = insensitive(compiled.controller, obs, "float")
    assert len(kept) > 0.4 * len(obs)
    actions, _ = compiled.at(kept)
    assert error(actions, compiled.controller.evaluate(kept), compiled.controller) < 1e-5


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("precision", ["double", "float"])
@pytest.mark.parametrize("name", ["reactor", "two tanks, by a walk"])
def test_the_self_test_passes_and_can_fail(name, precision, compiler, tmp_path):
    export(policy_of(name), tmp_path / "plant.c", precision=precision)
    passed = self_test(tmp_path, compiler=compiler)
    assert passed.returncode == 0 and "passed" in passed.stdout
    code = tmp_path / "plant.c"
    text = code.read_text()
    broken = re.sub(r"(action\[i\] = law\[i\]) \*", r"\1 * (real)1.001 *", text)
    assert broken != text
    code.write_text(broken)
    assert self_test(tmp_path, compiler=compiler).returncode == 1


def test_a_header_is_for_cpp_too(tmp_path):
    export(policy_of("reactor"), tmp_path / "plant.c")
    main = tmp_path / "main.cpp"
    main.write_text('#include "plant.h"\nint main() { plant_state s; plant_init(&s); }\n')
    compiler = COMPILERS[0]
    subprocess.run([compiler, *STRICT, "-c", "plant.c"], cwd=tmp_path, check=True)
    built = [compiler, "-x", "c++", "-Wall", "-Werror", "main.cpp", "-x", "none", "plant.o", "-lm"]
    assert subprocess.run(built, cwd=tmp_path).returncode == 0


def test_names_cannot_end_a_comment(tmp_path):
    law = solved("reactor").explicit()
    plain = law.model
    names = ["a", "b???/", "c", 'T */ int x; /* "Ä\\']
    model = LinearModel(plain.A, plain.B, plain.dt, state_names=names)
    compiled = Compiled(law.on_plant(model, np.zeros(4)), tmp_path)
    assert abs(compiled.at(np.zeros((1, 4)))[0]) < 1e-9  # of 8.4 K/min


@pytest.mark.parametrize("old", ["plant.c", "plant.h", "plant_selftest.c"])
def test_files_of_two_exports_do_not_compile(old, tmp_path):
    for name in ("reactor", "confined"):
        (tmp_path / name).mkdir()
        export(policy_of(name), tmp_path / name / "plant.c", name="plant")
    shutil.copy(tmp_path / "confined" / old, tmp_path / "reactor" / old)
    sources = [str(tmp_path / "reactor" / each) for each in ("plant.c", "plant_selftest.c")]
    built = [COMPILERS[0], *sources, "-lm", "-o", str(tmp_path / "test")]
    said = subprocess.run(built, capture_output=True, text=True)
    assert said.returncode != 0
    assert "is of another export than this file: export again" in said.stderr


@pytest.mark.parametrize("precision", ["double", "float"])
def test_a_reading_that_is_huge_is_outside(precision, tmp_path):
    largest = float(np.finfo(np.float64 if precision == "double" else np.float32).max)
    mpc = LinearMPC(
        LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1),
        Q=1e16 * np.eye(2), R=[[1e15]], horizon=3, x_min=[-5e-8, -2e-8], x_max=[5e-8, 2e-8],
        u_min=-1e-8, u_max=1e-8,
    )  # fmt: skip
    compiled = Compiled(mpc.explicit(), tmp_path, precision=precision)
    signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1], [1, 0], [0, -1]])
    for size in (largest, largest / 1e3, 1e30):
        actions, found = compiled.at(size * signs)
        assert np.all(found == Status.OUTSIDE)
        assert not compiled.controller.in_domain(size * signs).any()
        wanted = compiled.controller.evaluate(size * signs)
        assert error(actions, wanted, compiled.controller) < 1e-5


@pytest.mark.parametrize("wide", [False, True])
def test_inputs_without_bounds_and_a_box_that_mostly_has_no_solution(wide, tmp_path):
    box = {"theta_min": -5e3, "theta_max": 5e3, "u_min": -1, "u_max": 1} if wide else {}
    model = LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1)
    bounds = {"x_min": [-5, -2], "x_max": [5, 2]}
    mpc = LinearMPC(model, Q=np.eye(2), R=[[0.1]], horizon=3, **bounds, **box)
    export(mpc.explicit(), tmp_path / "plant.c")
    assert self_test(tmp_path).returncode == 0


@pytest.mark.parametrize("precision", ["double", "float"])
def test_readings_that_are_large_beside_their_box_are_exported(precision, tmp_path):
    A = [[0.92, 0.05, 0], [0, 0.85, 0.1], [0.02, 0, 0.7]]
    B = [[0.3, 0], [0.1, 0.2], [0, 0.25]]
    model = LinearModel(A, B, 2.0, x_ss=[50, 300, 12], u_ss=[3, 40])
    limits = {"u_min": [0, 20], "u_max": [6, 60], "x_min": [45, 290, 0], "x_max": [55, 310, 30]}
    weights = {"Q": np.diag([1, 0.2, 0.1]), "R": np.diag([0.5, 0.02]), "horizon": 3}
    export(LinearMPC(model, **weights, **limits), tmp_path / "plant.c", precision=precision)
    assert self_test(tmp_path).returncode == 0


@pytest.mark.parametrize("file", ["plant.c", "plant.st", "plant.xml"])
def test_float_beside_a_huge_operating_point_is_refused(file, tmp_path):
    model = LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1, x_ss=[1e8, 0], u_ss=[0])
    bounds = {"x_min": [1e8 - 5, -2], "x_max": [1e8 + 5, 2], "u_min": -1, "u_max": 1}
    law = LinearMPC(model, Q=np.eye(2), R=[[0.1]], horizon=3, **bounds).explicit()
    with pytest.raises(ValueError, match="Pass precision='double'"):
        export(law, tmp_path / file, precision="float")
    assert list(tmp_path.iterdir()) == []


def test_code_names_units_limits_and_the_time_of_a_step(tmp_path):
    units = {"units": {"level": "cm", "flow": "L/s"}, "time_unit": "min"}
    names = {"state_names": ["level"], "input_names": ["flow"], "x_ss": [12], "u_ss": [3]}
    tank = LinearModel([[0.9]], [[0.5]], dt=2, **names, **units)
    mpc = LinearMPC(tank, Q=[[1]], R=[[1]], horizon=3, x_min=0, x_max=20, u_min=0, u_max=10)
    for given in (mpc, mpc.explicit()):
        for file in ("tank.h", "tank.st"):
            code = tmp_path / file.replace(".h", ".c")
            export(given, code, checks=Checks(obs_min=0, obs_max=20))
            text = (tmp_path / file).read_text()
            assert "A step is 2 min." in text and "[0]  flow (L/s), 0 to 10" in text
            assert "obs[0]  level (cm), 12 at rest, good within 0 to 20" in text


HOSTILE_STEPS = os.environ.get("HOSTILE_STEPS")
"""How long C code is fed with hostile readings; where it is set, that of every policy."""
HOSTILE_CASES = (
    CASES if HOSTILE_STEPS else ["reactor", "references and rates", "two tanks, by a walk"]
)
HOSTILE = """#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "plant.h"
static unsigned long long seed = 88172645463325252ULL;
static unsigned long long draw(void)
{
    seed ^= seed << 13;
    seed ^= seed >> 7;
    return seed ^= seed << 17;
}
static REAL bits(void)
{
    unsigned long long drawn = draw();
    REAL found;
    memcpy(&found, &drawn, sizeof found);
    return found;
}
static REAL reading(void)
{
    const REAL odd[] = {(REAL)NAN, (REAL)INFINITY, (REAL)-INFINITY, (REAL)MOST, -(REAL)MOST,
        (REAL)LEAST, (REAL)0.0, (REAL)-0.0, (REAL)1e30, (REAL)-1e-30};
    unsigned long long kind = draw() % 6;
    if (kind < 2)
        return odd[draw() % 10];
    if (kind == 2)
        return bits();
    return (REAL)((double)(draw() % 20001) / 1000.0 - 10.0);
}
int main(int argc, char **argv)
{
    plant_state s;
    REAL obs[N_OBS], action[N_ACTIONS], manual[N_ACTIONS];
    long steps = argc > 1 ? atol(argv[1]) : 20000;
    plant_init(&s);
    for (long k = 0; k < steps; k++) {
        if (draw() % 1000 == 0)
            plant_init(&s);
        /* Most are beside the operating point. */
        REAL calm = draw() % 4 ? (REAL)0.1 : (REAL)1.0;
        for (int i = 0; i < N_OBS; i++)
            obs[i] = calm < 1 && draw() % 20 ? calm * (REAL)(draw() % 1000) / 500 : reading();
        for (int i = 0; i < N_ACTIONS; i++)
            manual[i] = reading();
        int request = (int)(draw() % 3);
        plant_step(&s, obs, reading(), request, draw() % 2 ? manual : 0, action);
        for (int i = 0; i < N_ACTIONS; i++)
            if (!(action[i] >= (REAL)LOW(i) && action[i] <= (REAL)HIGH(i))) {
                printf("step %ld: action %d is %g\\n", k, i, (double)action[i]);
                return 1;
            }
        (void)plant_policy(obs, action);
        (void)plant_law(obs, action);
    }
    return 0;
}
"""


def sanitizers(folder) -> list[str]:
    (folder / "one.c").write_text("int main(void) { return 0; }\n")
    flags = ["-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    built = [COMPILERS[0], *flags, "one.c", "-o", "one"]
    found = subprocess.run(built, cwd=folder, capture_output=True)
    if found.returncode or subprocess.run([str(folder / "one")], capture_output=True).returncode:
        pytest.skip("the compiler has no sanitizers")
    return flags


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["double", pytest.param("float", marks=pytest.mark.nightly)])
@pytest.mark.parametrize("name", HOSTILE_CASES)
def test_hostile_readings_break_no_rule_of_c_and_no_bound(name, precision, tmp_path):
    flags = sanitizers(tmp_path)
    policy = policy_of(name)
    export(policy, tmp_path / "plant.npz", checks=Checks(frozen_after=3, hold=2, recover=2))
    written = Controller.load(tmp_path / "plant.npz").data
    options = {"checks": Checks(frozen_after=3, hold=2, recover=2), "precision": precision}
    export(policy, tmp_path / "plant.c", **options)
    ends = written["bounds"] * written["action_scale"] + written["action_shift"]
    room = 1e-6 * (1 + np.abs(ends).max())
    low, high = ("{" + ", ".join(f"{v:.17g}" for v in side) + "}" for side in
                 (ends[0] - room, ends[1] + room))  # fmt: skip
    largest = {"double": ("DBL_MAX", "5e-324"), "float": ("FLT_MAX", "1e-45")}[precision]
    numbers = {
        "REAL": precision, "MOST": largest[0], "LEAST": largest[1],
        "N_OBS": len(written["obs_rest"]), "N_ACTIONS": len(written["action_scale"]),
        "LOW(i)": f"((const double[]){low})[i]", "HIGH(i)": f"((const double[]){high})[i]",
    }  # fmt: skip
    head = "".join(f"#define {key} {value}\n" for key, value in numbers.items())
    (tmp_path / "main.c").write_text(head + HOSTILE)
    strict = [each for each in STRICT if each != "-Werror"]
    built = [COMPILERS[0], *strict, *flags, "main.c", "plant.c", "-lm", "-o", "main"]
    subprocess.run(built, cwd=tmp_path, check=True, capture_output=True)
    program = [str(tmp_path / "main"), HOSTILE_STEPS or "20000"]
    ran = subprocess.run(program, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
