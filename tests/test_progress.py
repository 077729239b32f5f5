"""What takes long is shown on stderr: a bar for a person, few lines in a file, else nothing."""

import io
import math
import sys

import numba
import pytest
from numba.core.dispatcher import Dispatcher

from fresh_process import run_python
from sb3_yann import _progress
from sb3_yann._progress import Progress, bar, is_watched, say, shown
from sb3_yann.control._kernels import law, online, polyhedra
from sb3_yann.networks._kernels import afterstate_value, yann_layer
from sb3_yann_envs import cstr


class Clock:
    """Seconds that pass only when a test says so."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(_progress.time, "monotonic", found)
    monkeypatch.setattr(_progress._Lines, "latest", -math.inf)
    return found


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def counted(clock: Clock, each: float, n: int = 100, timed: bool = False) -> None:
    made = bar("plans", total=n, timed=timed)
    made._time = clock
    made.start_t = made.last_print_t = clock()
    for _ in range(n):
        clock.now += each
        made.update()
    made.close()


def test_what_takes_less_than_three_seconds_shows_nothing(clock, capsys) -> None:
    counted(clock, each=0.029)
    Progress()("done")
    assert capsys.readouterr() == ("", "")


def test_a_file_gets_a_line_after_three_seconds_then_one_each_half_minute(clock, capsys) -> None:
    counted(clock, each=1.0)
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert out == "" and len(lines) == 4 and "\r" not in err
    assert lines[0] == "plans: 3 of 100, 00:03 so far, 01:37 left"


def test_a_terminal_gets_a_bar_that_goes_again(clock, monkeypatch) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setattr(sys, "__stderr__", screen)
    assert is_watched()
    counted(clock, each=1.0)
    assert "\n" not in screen.getvalue() and "\rplans:  50%" in screen.getvalue()
    assert screen.getvalue().split("\r")[-2].strip() == ""
    # Where another bar has taken stderr there are lines.
    monkeypatch.setattr(sys, "stderr", Terminal())
    assert not is_watched()


def test_lines_name_the_time_the_steps_and_what_is_left(clock, capsys) -> None:
    progress = Progress(lambda: 1234)
    clock.now += 5.0
    progress("a round is over", left=20.0)
    assert capsys.readouterr().err == (
        "[    5 s     1,234 steps, about 20 s more if all is needed] a round is over\n"
    )


def test_a_line_that_cannot_be_printed_as_it_is_ends_nothing(monkeypatch) -> None:
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, "ascii", write_through=True))
    say("3 °C")
    assert written.getvalue() == b"3 \\xb0C\n"
    sys.stdout.close()
    say("nobody reads this")


def test_false_silences_all_that_is_called(clock, capsys) -> None:
    with shown(False), shown(True):
        progress = Progress()
        counted(clock, each=1.0)
        progress("a round is over")
    assert capsys.readouterr() == ("", "")
    counted(clock, each=1.0)
    assert capsys.readouterr().err


LAWS = law, online, polyhedra
MODULES = (*LAWS, yann_layer, afterstate_value, cstr)
CALLED = {
    f"{module.__name__}.{name}": function
    for module in MODULES
    for name, function in vars(module).items()
    if isinstance(function, Dispatcher) and not function._can_compile  # others are parts of these
}


@pytest.mark.parametrize("name", CALLED)
def test_no_compiled_function_that_python_calls_returns_an_array(name) -> None:
    scalars = numba.types.Number, numba.types.Boolean, numba.types.NoneType
    for signature in CALLED[name].nopython_signatures:
        returned = signature.return_type
        # A tuple of numbers is made without any code of Python; an array is not.
        parts = returned if isinstance(returned, numba.types.UniTuple) else [returned]
        assert all(isinstance(each, scalars) for each in parts), returned


def test_all_that_is_known_to_be_called_is_looked_at() -> None:
    names = {name.rpartition(".")[2] for name in CALLED}
    known = "law_at law_of_batch locate_batch bounded_region support solve_batch inputs_of_batch"
    known += " recall remember forward backward _forward _backward _adam"
    assert names >= {*known.split(), "_rates", "advance", "advance_all", "is_rich"}


@pytest.mark.slow
def test_compiled_code_is_loaded_when_a_policy_is_built() -> None:
    # In learn a Ctrl-C while numba begins would break it for the whole process.
    program = """
import sys, sb3_yann
from stable_baselines3 import DDPG
for critic in ("state_action", "afterstate"):
    DDPG("YannPolicy", "CSTR-v0", device="cpu", policy_kwargs={"critic": critic})
    print(*sys.modules)
"""
    for line, both in zip(run_python(program)[0].splitlines(), (False, True), strict=True):
        loaded = line.split()
        assert "sb3_yann.networks._kernels.yann_layer" in loaded
        assert ("sb3_yann.networks._kernels.afterstate_value" in loaded) is both


INTERRUPTED = """
import collections, random, signal
import gymnasium, torch as th
from stable_baselines3 import DDPG
from sb3_yann import NoActionNoise, YannPolicy

th.set_num_threads(1)
draw, raised = random.Random(0), collections.Counter()
model = DDPG(YannPolicy, gymnasium.make("CSTR-v0"), seed=0, batch_size=8, learning_starts=10)
model.learn(50, callback=NoActionNoise())
# A shell starts what runs in its background with the signal ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
for _ in range(30):
    th.set_grad_enabled(True)  # which torch's own no_grad forgets if it is cut off itself
    model._last_obs = None  # an episode may have been cut off in the midst of a step
    try:
        signal.setitimer(signal.ITIMER_REAL, draw.uniform(0.01, 0.04), 1.0)
        model.learn(10**6, callback=NoActionNoise(), reset_num_timesteps=False)
    except (KeyboardInterrupt, Exception) as error:
        raised[type(error).__name__] += 1
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
print(dict(raised))
"""


@pytest.mark.slow
def test_ctrl_c_at_any_moment_of_training_is_a_keyboard_interrupt() -> None:
    assert run_python(INTERRUPTED)[0] == "{'KeyboardInterrupt': 30}\n"
