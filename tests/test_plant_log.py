"""Logs are cut where time is missing, and nothing else is lost."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sample_plants import played
from sb3_yann import (
    DisturbanceBounds,
    LinearModel,
    LinearMPC,
    PlantTwin,
    StateEstimator,
    Tracking,
    identify,
    identify_outputs,
)
from sb3_yann.log import Episode, Log
from sb3_yann.log import split_episodes as split


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Write lines to a log; return its path."""

    def write(*lines: str) -> Path:
        (tmp_path / "log.csv").write_text("\n".join(lines), encoding="utf-8")
        return tmp_path / "log.csv"

    return write


def numbered(steps: int) -> Episode:
    return Episode(np.arange(steps + 1.0)[:, None], np.arange(steps) + np.zeros((1, steps)).T)


def without_gaps(records: list[Episode], times: list, dt: float) -> tuple[tuple[Episode, ...], int]:
    states, inputs = ([getattr(each, name) for each in records] for name in ("states", "inputs"))
    log = Log.from_arrays(states, inputs, dt, time=times)
    return log.episodes, log.lost_steps


def test_every_step_but_those_of_another_length_is_kept() -> None:
    time = np.array([0, 1, 2, 5, 6, 7, 9, 10], float)  # steps 2 and 5 are gaps
    parts, lost = without_gaps([numbered(7)], [time], 1.0)
    assert lost == 2
    assert [each.states[:, 0].tolist() for each in parts] == [[0, 1, 2], [3, 4, 5], [6, 7]]


def test_the_last_steps_of_all_are_held_out_and_none_is_in_both_parts() -> None:
    fitted, tested = split([numbered(6), numbered(4)], 0.5)
    assert [len(each) for each in fitted] == [5] and [len(each) for each in tested] == [1, 4]
    assert fitted[0].states[-1] == tested[0].states[0] == 5


@pytest.mark.parametrize(("longer", "lost"), [(0.099, 0), (-0.099, 0), (0.101, 1), (-0.101, 1)])
def test_a_step_a_tenth_of_dt_too_long_or_too_short_is_none(longer: float, lost: int) -> None:
    time = 2.0 * np.arange(10)
    time[4:] += 2.0 * longer
    parts, gone = without_gaps([numbered(9)], [time], 2.0)
    assert gone == lost and sum(map(len, parts)) == 9 - lost
    with pytest.warns(UserWarning, match=r"step of the log takes 2.1 on average: pass dt=2.1"):
        without_gaps([numbered(30)], [2.1 * np.arange(31) + 9 * (np.arange(31) > 7)], 2.0)


def test_stamps_that_jitter_about_one_grid_are_on_it() -> None:
    rng = np.random.default_rng(0)
    grid = 30.0 * np.arange(301)
    assert len(without_gaps([numbered(300)], [grid + rng.integers(-4, 5, 301)], 30)[0]) == 1
    with pytest.warns(UserWarning, match="differ from dt = 30 .* an episode ends at each"):
        without_gaps([numbered(300)], [grid + rng.integers(-8, 9, 301)], 30)
    grid[150:] += 8  # the grid itself moves
    assert 1 < len(without_gaps([numbered(300)], [grid + rng.integers(-2, 3, 301)], 30)[0]) < 5


def test_where_more_than_half_of_the_steps_are_none_the_unit_is_another() -> None:
    def times(gaps: int) -> np.ndarray:
        return np.cumsum([0.0, *[3.0] * gaps, *[1.0] * (8 - gaps)])

    parts, lost = without_gaps([numbered(8)], [times(4)], 1.0)
    assert lost == 4 and [len(each) for each in parts] == [4]
    for time, said in ((times(5), r"3 \(the median\)"), (60 * times(0), 'time_unit="min"')):
        with pytest.raises(ValueError, match=f"dt = 1, but a step of the log takes .*{said}"):
            without_gaps([numbered(8)], [time], 1.0)
    with pytest.raises(ValueError, match="time has 2 episodes, states has 1"):
        without_gaps([numbered(8)], [times(0), times(0)], 1.0)


def test_disturbances_are_columns_behind_the_inputs_and_one_step_is_no_log() -> None:
    x = np.zeros((4, 2))
    u = np.ones((3, 1))
    log = Log.from_arrays(x, u, 1.0, disturbances=np.full((3, 2), 5.0))
    (episode,) = log.episodes
    assert log.sizes == (2, 1, 2)
    np.testing.assert_array_equal(episode.regressors, np.tile([0, 0, 1, 5, 5], (3, 1)))
    several = Log.from_arrays(np.zeros((2, 4, 2)), np.ones((2, 3, 1)), 1.0)
    assert several.sizes == (2, 1, 0) and [len(each) for each in several.episodes] == [3, 3]
    with pytest.raises(ValueError, match="one step says nothing"):
        Log.from_arrays(x[:2], u[:1], 1.0)


CSV = """run,t,level,T,valve,load
1,0,1.0,20,0.5,7
1,10,1.1,21,0.6,7
1,20,1.2,22,,
2,0,2.0,23,0.5,8
2,10,2.1,24,0.6,8
2,30,2.2,25,0.7,8
2,40,2.3,26,0.8,8
2,50,,,0.8,8
2,60,2.5,27,0.8,8
2,70,2.6,28,0.9,8
"""


def test_a_csv_file_is_cut_where_an_episode_or_a_reading_ends(write) -> None:
    columns = {"disturbances": ["load"], "episode": "run", "time": "t"}
    log = Log.from_csv(write(CSV), states=["level", "T"], inputs=["valve"], dt=10, **columns)
    states = [[1.0, 1.1, 1.2], [2.0, 2.1], [2.2, 2.3], [2.5, 2.6]]
    assert [each.states[:, 0].tolist() for each in log.episodes] == states
    inputs = [[0.5, 0.6], [0.5], [0.7], [0.8]]
    assert [each.inputs[:, 0].tolist() for each in log.episodes] == inputs
    assert log.lost_steps == 3 and log.state_names == ("level", "T")
    assert log.every == (1, 1) and log.with_all_states() is log
    assert log.episodes[0].disturbances.tolist() == [[7], [7]]
    given = {"states": ["level", "Tä"], "inputs": ["valve"], "dt": 10, "delimiter": ";", **columns}
    path = write()
    path.write_text(CSV.replace(",", ";").replace(".", ",").replace("T", "Tä"), "latin-1")
    read = Log.from_csv(path, **given, decimal=",", encoding="latin-1")
    assert [each.states[:, 0].tolist() for each in read.episodes] == states
    for wrong, match in ((given, "pass encoding="), (given | {"encoding": "latin-1"}, "decimal=")):
        with pytest.raises(ValueError, match=match):
            Log.from_csv(path, **wrong)
    with pytest.warns(UserWarning, match=r"All 10 rows .* one record.*\['run', 't', 'T', 'load'"):
        Log.from_csv(write(CSV), states=["level"], inputs=["valve"], dt=10)
    with pytest.raises(ValueError, match=r"begins anew in each episode, name .* episode="):
        Log.from_csv(write(CSV), states=["level"], inputs=["valve"], dt=10, time="t")


def test_a_mark_for_no_reading_is_named(write) -> None:
    given = {"states": ["T"], "inputs": ["valve"], "dt": 10, "episode": "run"}
    with pytest.warns(UserWarning, match="T of the log is -999.25 in 2 rows, far from all others"):
        marked = write(CSV.replace(",24,", ",-999.25,").replace(",27,", ",-999.25,"))
        log = Log.from_csv(marked, **given)
    assert log.lost_steps and min(each.states.min() for each in log.episodes) > 0  # no reading
    Log.from_csv(write(CSV.replace(",24,", ",999,").replace(",27,", ",900,")), **given)  # no mark


def test_set_points_and_loads_of_a_csv_file_reach_the_twin(write) -> None:
    model = LinearModel([[0.9]], [[0.5]], 1, [12], [3], E=[[0.1]], d_ss=[1])
    mpc = LinearMPC(
        model, Q=[[1]], R=[[1]], horizon=2, x_min=0, x_max=20, u_min=0, u_max=10,
        tracking=Tracking([0], 5, 15), disturbances=DisturbanceBounds(0, 2),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    lines = ["run,h [cm],q,load,h_sp [cm]"]
    states = []
    inputs = []
    held = []
    for run in range(6):
        x = [rng.uniform(5, 15)]
        u = rng.uniform(2, 4, 8)
        d = rng.uniform(0.5, 1.5, 9)
        r = np.repeat(rng.uniform(5, 15, 3), 3)
        for t in range(8):
            x.append(12 + 0.9 * (x[-1] - 12) + 0.5 * (u[t] - 3) + 0.1 * (d[t] - 1))
        rows = zip(x, [*u, u[-1]], d, r, strict=True)
        lines += [f"{run},{','.join(map(repr, map(float, row)))}" for row in rows]
        states.append(np.array(x)[:, None])
        inputs.append(u[:, None])
        held.append(([*r[:-1], r[-2]], [*d[:-1], d[-2]]))  # the last row's count for nothing
    path = write(*lines)
    columns = {"disturbances": ["load"], "references": ["h_sp"], "episode": "run"}
    log = Log.from_csv(path, ["h"], ["q"], 1, **columns)
    assert log.units == ("cm", "", "") and log.disturbance_names == ("load",)
    of_log = PlantTwin.fit(mpc, log, residuals=["none"])
    references, disturbances = (
        [np.array(part)[:, None] for part in each] for each in zip(*held, strict=True)
    )
    pairs = [*zip(states, inputs, strict=True)]
    given = {"references": references, "disturbances": disturbances}
    plain = PlantTwin.fit(mpc, pairs, **given, residuals=["none"])
    for one, other in zip(of_log.episodes, plain.episodes, strict=True):
        np.testing.assert_array_equal(one.thetas, other.thetas)
    assert np.ptp([each.thetas[:, 1] for each in of_log.episodes]) > 1
    assert [len(each) for each in log.cut(5).episodes] == [5, 3] * 6
    assert log.cut(5).episodes[1].references.tolist() == log.episodes[0].references[5:].tolist()


def test_a_laboratory_value_now_and_then_is_kept_for_models_of_outputs(write) -> None:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, 300), 4)
    plant = LinearModel([[0.9, 0], [0.2, 0.7]], [[0.3], [0]], 1)
    x = played(plant.step, u[:, None], [0, 0])
    shown = x + 0.01 * rng.normal(size=x.shape)
    rows = [
        f"{shown[k, 0]:.6f},{'' if k % 10 else f'{shown[k, 1]:.6f}'},{u[min(k, 1199)]:.6f}"
        for k in range(1201)
    ]
    rows[700] = f",,{u[700]:.6f}"
    log = Log.from_csv(write("T,quality,valve", *rows), ["T", "quality"], ["valve"], dt=1)
    assert [len(each) for each in log.episodes] == [699, 499]
    assert (log.every, log.lost_steps) == ((1, 10), 2)
    found = identify_outputs(log, order=2, delay=0)
    assert "Read now and then: quality every 10 samples" in found.report()
    guess = found.predict(x, u[:, None], ahead=20)
    assert np.std((guess - x[20:])[40:], axis=0).max() < 0.05  # x moves by .7 and .5
    with pytest.raises(ValueError, match=r"quality every 10 samples.*identify_outputs"):
        identify(log)
    box = {"u_min": -1, "u_max": 1, "theta_min": -9, "theta_max": 9}
    mpc = LinearMPC(plant, Q=np.eye(2), R=[[1]], horizon=2, tracking=Tracking([0], -1, 1), **box)
    with pytest.raises(ValueError, match=r"quality every 10 samples.*PlantTwin.fit\(mpc, log, obs"):
        PlantTwin.fit(mpc, log)
    observer = StateEstimator(mpc.model, [0, 1], every=[1, 10])
    given = {"references": [[0.0], [0.0]], "observer": observer, "residuals": ["linear"]}
    assert len(PlantTwin.fit(mpc, log, **given).episodes) == 2


def test_gaps_do_not_change_how_often_a_state_is_read_and_repeats_are_named() -> None:
    held, moving = np.sin(np.divmod(np.arange(401), 20))  # a reading that stays for 20 rows
    with pytest.warns(UserWarning, match=r"x\[0\] changes only once in 20 rows"):
        Log.from_arrays(np.c_[held, moving], moving[:-1, None], 1)
    for z, u in ((np.arange(401) // 20, moving), (np.sign(held), moving), (held, held)):  # none
        Log.from_arrays(np.c_[z, moving], u[:-1, None], 1)
    x = np.zeros((201, 2))
    x[np.arange(201) % 20 > 0, 1] = np.nan
    x[[40, 50, 80, 120]] = np.nan
    u = np.ones((200, 1))
    assert Log.with_gaps(x, u, 1).every == (1, 20)
    x[1::3, 0] = np.nan  # many short gaps, as of readings that are lost at random
    assert len(Log.with_gaps(x, u, 1)) == 1
    x[:, 0] += moving[:201] + 1e6 * (np.arange(201) == 3)
    x[60:68, 0] = -40  # a transmitter that is down
    with pytest.warns(UserWarning, match=r"x\[0\] of the log is 1e\+06 in row 3, .* \(9 such rows"):
        log = Log.with_gaps(x[:, :1], u, 1)
    assert all(np.nanmax(np.abs(each.states)) < 9 for each in log.episodes)


@pytest.mark.filterwarnings("ignore:valve has no effect")
def test_a_state_that_is_often_read_is_cut_where_it_is_missing(write) -> None:
    rows = [f"{'Bad Input' if k % 5 == 4 else np.sin(k)},{np.sin(3 * k)}" for k in range(40)]
    with pytest.warns(UserWarning, match="T of .* is 'Bad Input' in 8 rows: taken for no"):
        log = Log.from_csv(write("T,valve", *rows), ["T"], ["valve"], dt=1)
    assert {len(each) for each in log.episodes} == {3} and log.every == (1,)
    assert identify(log).model.n_states == 1


TWO = "level,valve\n"


@pytest.mark.parametrize(
    ("text", "states", "said"),
    [
        (CSV, ["h"], r"no column 'h'; it has \[[^\]]*\].$"),
        ("h [cm];valve\n1;2\n", ["h"], "pass delimiter=';'.$"),
        ("h [cm]\tvalve\n1\t2\n", ["h"], r"pass delimiter='\\t'.$"),
        ("", ["h"], r"it has \[\]. It is empty."),
        (CSV, "level", "list of column names"),
        (CSV, ["level"], r"disturbances = 'level' must be a list of column names"),
        (CSV.replace("1.1", "1.1.1"), ["level"], "line 3: level is '1.1.1', expected a number"),
        (TWO, ["level"], "no rows below its"),
        (f"{TWO}1,ON\n3,OFF\n", ["level"], "valve is 'ON' in 1 rows, 'OFF' in 1 rows, and never"),
        (f"{TWO}1,2\n", ["level"], "no two rows"),
        (f"{TWO}1,\n,2\n", ["level"], "no two samples"),
        ("level,level,valve\n1,2,3\n4,5,6\n", ["level"], "several columns 'level'"),
        (f"{TWO}1,2\n3,4\n", ["level", "valve"], "'valve' is named twice"),
        (f"{TWO}1,2\n1,5,2,3\n", ["level"], "line 3 has more entries than the header, .* Leave"),
    ],
)
def test_a_csv_file_that_does_not_fit_is_named(write, text, states, said) -> None:
    with pytest.raises(ValueError, match=said):
        loads = "level" if said[0] == "d" else ()
        Log.from_csv(write(text), states, ["valve"], 10, disturbances=loads)
    with pytest.raises(ValueError, match=r"level is '1\.0', expected .* decimal sign is ','"):
        text = CSV.replace(",", ";")
        Log.from_csv(write(text), ["level"], ["valve"], 10, delimiter=";", decimal=",")
    with pytest.raises(ValueError, match="level is '1_0', expected a number"):
        Log.from_csv(write(CSV.replace("1.0", "1_0")), ["level"], ["valve"], 10)
    with pytest.raises(ValueError, match=r"no column 'level'; .* pass delimiter=','.$"):
        Log.from_csv(write(CSV), states=["level"], inputs=["valve"], dt=10, delimiter=";")


@pytest.mark.parametrize(("header", "first", "said"), [
    ("time", "20260131080000", "time is '20260131080000', expected a number or a time stamp"),
    ("time [ticks]", "0", r"times in 'ticks' by its header, and time_unit = 'min'"),
])  # fmt: skip
def test_times_in_what_is_no_unit_are_named(write, header: str, first: str, said: str) -> None:
    text = f"{header},level,valve\n{first},1,2\n{int(first) + 10},3,4\n"
    with pytest.raises(ValueError, match=said):
        Log.from_csv(write(text), ["level"], ["valve"], 10, time="time", time_unit="min")


def test_identify_takes_a_log_with_its_names(write) -> None:
    u = np.random.default_rng(0).normal(size=80)
    x = played(lambda x, u: 0.8 * x + 0.5 * u, u, 0.0)
    rows = [f"{a:.12g};{b:.12g}" for a, b in zip(x, [*u, 0.0], strict=True)]
    log = Log.from_csv(
        write("level;valve", *rows), states=["level"], inputs=["valve"], dt=2, delimiter=";"
    )
    model = identify(log).model
    assert model.state_names == ("level",) and model.input_names == ("valve",) and model.dt == 2
    np.testing.assert_allclose([model.A[0, 0], model.B[0, 0]], [0.8, 0.5], atol=1e-9)
    with pytest.raises(TypeError, match="'dt'"):
        identify(log, dt=2)
    with pytest.raises(TypeError, match="takes a Log, or states and actions"):
        identify(x)


def test_headers_with_units_and_the_unit_of_time_reach_model_report_and_plots(write) -> None:
    u = np.random.default_rng(0).normal(size=60)
    x = played(lambda x, u: 0.8 * x + 0.5 * u, u, 0.0)
    rows = zip(10 * np.arange(60), x, u, np.sin(u**2), strict=False)
    lines = (f"{t},{a:.6f},{b:.6f},{c:.6f}" for t, a, b, c in rows)
    path = write("time [s],T [K],valve,F1 [kg]", *lines)
    log = Log.from_csv(path, ["T"], ["valve"], dt=10, time="time")
    assert Log.from_csv(path, ["T [K]"], ["valve"], dt=10, time="time").state_names == ("T",)
    assert not Log.from_csv(path, ["T"], ["F1"], 1 / 6, time="time", time_unit="min").lost_steps
    assert repr(log) == "Log(1 episode, 59 steps of dt = 10 s; 1 state (T), 1 input (valve))"
    model = identify(log).model
    assert (model.state_names, model.units, model.time_unit) == (("T",), ("K", ""), "s")
    assert identify_outputs(log, order=1, delay=0).model.units == ("K", "")
    assert "sampled every 10 s" in model.report() and "time constant 44.81 s" in model.report()
    assert replace(model, dt=5).time_unit == "s"
    loaded = Log.from_csv(path, ["T"], ["valve"], dt=10, time="time", disturbances=["F1"])
    for late in (identify(loaded, delay=1).model, identify_outputs(loaded, delay=1).model):
        assert "Disturbances: F1 (kg).\n" in late.report() and "T (K), " in late.report()
    mpc = LinearMPC(late, Q=late.C.T @ late.C, R=[[1]], horizon=2, u_min=-4, u_max=4,
                    disturbances=DisturbanceBounds(-1, 1))  # fmt: skip
    assert {"F1 (kg)"} == {*mpc.labels(units=True)} - {*mpc.labels()} - {"T (K)"}
    limits = {"x_min": -9, "x_max": 9, "u_min": -4, "u_max": 4}
    mpc = LinearMPC(replace(model, units=("C", "")), Q=[[1]], R=[[1]], horizon=2, **limits)
    with pytest.raises(ValueError, match="T is in K in the log, and in C in the model of the MPC"):
        PlantTwin.fit(mpc, log)
    assert PlantTwin.fit(mpc, log, units_confirmed=True, residuals=["none"]).kind == "none"
    with pytest.raises(ValueError, match=r"no column 'T \[C\]'; it has \['time \[s\]', 'T \[K\]'"):
        Log.from_csv(path, ["T [C]"], ["valve"], dt=10)
    with pytest.raises(TypeError, match="time_unit = 3 must be a str"):
        model.named(time_unit=3)
    assert model.named(["T"], ["valve"], time_unit="s") == model
    with pytest.raises(ValueError, match=r"time_unit = 'min', but dt is 10 s"):
        model.named(time_unit="min")


@pytest.mark.parametrize(("dt", "unit", "found"), [(120, "", "s"), (2, "min", "min")])
def test_time_stamps_are_in_the_unit_of_dt(dt, unit, found, write) -> None:
    rows = [f"2026-10-25T02:{(30 + 2 * k) % 60:02}+0{2 - k // 15}:00,{k},1" for k in range(20)]
    log = Log.from_csv(write("at,T,valve", *rows), ["T"], ["valve"], dt, time="at", time_unit=unit)
    assert (len(log.episodes[0]), log.time_unit, log.lost_steps) == (19, found, 0)
    path = write("at,T,valve", *rows, "13/03/2026 08:00,1,2")
    with pytest.raises(ValueError, match=r"line 22: at is '13/03/.*a number or a time stamp"):
        Log.from_csv(path, ["T"], ["valve"], dt=dt, time="at")
    with pytest.raises(ValueError, match="time_unit = 'hours': expected one of"):
        Log.from_csv(path, ["T"], ["valve"], dt=dt, time="at", time_unit="hours")


def test_a_unit_that_changes_amid_the_log_is_named_and_a_step_is_not() -> None:
    u = np.random.default_rng(0).normal(size=(120, 1))
    x = 80 + np.cumsum(np.vstack([u, u[:1]]), axis=0) / 5
    later = np.arange(121)[:, None] >= 60
    with pytest.warns(UserWarning, match=r"From row 60 .* x\[0\] reads what it did \+273.15"):
        Log.from_arrays(x + 273.15 * later, u, dt=1)
    with pytest.warns(UserWarning, match="reads 0.001 times what it did: has its unit changed"):
        Log.from_arrays(np.where(later, x / 1000, x), u, dt=1)
    Log.from_arrays(x + 200.0 * later, u, dt=1)
