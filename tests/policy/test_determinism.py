"""Trainings with the same seed are the same, bit for bit, in whatever process they run."""

from pathlib import Path

import pytest
import torch as th

from fresh_process import run_python
from guard_samples import STEPS, build, train
from resumed import envs, guard_in_simulator, model_bits

# The sample plant pays otherwise, and ignores its input.
pytestmark = pytest.mark.filterwarnings(
    "ignore:The reward is not minus", r"ignore:u\[0\] moves the env otherwise.* 0 times"
)
CODE = "import resumed; resumed.fresh_trainings()"


@pytest.mark.parametrize("n_envs", [1, 4])
def test_two_trainings_with_one_seed_are_the_same(n_envs, tmp_path) -> None:
    found = []
    for name in ("first.csv", "second.csv"):
        th.manual_seed(len(found))  # what came before does not matter
        model = build(env=envs(n_envs))
        guard = guard_in_simulator(log_path=tmp_path / name)
        train(model, 8 * STEPS, guard)
        assert guard.decisions
        found.append([model_bits(model), (tmp_path / name).read_bytes()])
    assert found[0] == found[1]


@pytest.mark.nightly
def test_so_they_are_in_fresh_processes_with_machine_code_that_is_new_or_kept(tmp_path) -> None:
    kept = tmp_path / "code"
    outputs = []
    for _ in range(2):
        printed, _ = run_python(CODE, tmp_path / "models", kept)
        outputs.append((printed.splitlines(), _times(kept)))
    (cold, written), (warm, read) = outputs
    assert written == read and len(written) > 3  # compiled in the first process, not in the second
    anew = [line for line in warm if line.startswith("anew")]
    assert anew == cold and len(anew) == 3
    for trained, resumed in zip(anew[:2], [each for each in warm if each not in anew], strict=True):
        assert resumed.split()[-1] == trained.split()[-1]
        assert int(trained.split()[2]) > 3  # decisions of the guard


def _times(folder: Path) -> dict[str, int]:
    return {each.name: each.stat().st_mtime_ns for each in folder.rglob("*.nbc")}
