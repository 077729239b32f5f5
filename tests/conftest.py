"""What every test runs with, and the problems that several of them go through."""

import os
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")  # SB3 would put models on a GPU
try:
    import torch as th
except ImportError:  # models, MPC and law are tested without, see noxfile.py
    th = None

from sample_plants import asymmetric_pendulum_mpc, two_input_mpc
from sb3_yann import LinearMPC
from sb3_yann_envs import problems

# `HYPOTHESIS_PROFILE=thorough` draws many more examples, and others each time.
settings.register_profile(
    "few", derandomize=True, deadline=None, suppress_health_check=list(HealthCheck)
)
settings.register_profile("thorough", settings.get_profile("few"), derandomize=False)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "few"))


@pytest.fixture(autouse=True)
def same_initial_weights() -> Iterator[None]:
    """Seed torch, and undo it: nothing may depend on which tests ran before."""
    if th is None:
        yield
        return
    with th.random.fork_rng(devices=[]):
        th.manual_seed(0)
        yield


@pytest.fixture
def brisk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let fits of models and policies be short."""
    from improvement_samples import quick

    quick(monkeypatch)


def pytest_configure(config: pytest.Config) -> None:
    config.option.loadscopereorder = False  # pytest-xdist would begin with files of many tests


# Files whose tests are slow for the most part.
DEAR = "commissioning extra headroom improve outputs report vector_training walk".split()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put files with slow tests first: begun last, one would hold up the end alone."""
    for item in items:
        if item.path.stem.removeprefix("test_") in DEAR:
            item.add_marker("slow")
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


PROBLEMS = {
    "pendulum": problems.clipped_pendulum,
    "cstr": problems.cstr,
    "asymmetric pendulum": asymmetric_pendulum_mpc,
    "two inputs": two_input_mpc,
}


@pytest.fixture(scope="session", params=PROBLEMS, ids=lambda name: name.replace(" ", "-"))
def mpc(request) -> LinearMPC:
    return PROBLEMS[request.param]()
