"""Timing and memory, and what it takes to do it again: versions, seeds, settings, fingerprints."""

from __future__ import annotations

import hashlib
import platform
import sys
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from os import PathLike, fspath
from time import perf_counter
from typing import Any

import numpy as np
from stable_baselines3.common.type_aliases import TrainFreq

from sb3_yann.commissioning.improve import fingerprint
from sb3_yann.control import PiecewiseAffine
from sb3_yann.guard.simulator_acceptance import name_of
from sb3_yann.reporting.html import join, lines, say, table, tag
from sb3_yann.reporting.subject import Part, Subject

CALLS = 200
LIBRARIES = (
    "sb3-yann", "stable-baselines3", "torch", "gymnasium", "numpy", "scipy", "numba", "daqp",
    "ppopt", "control", "matplotlib",
)  # fmt: skip
SETTINGS = (
    "gamma", "learning_rate", "batch_size", "buffer_size", "tau", "train_freq", "gradient_steps",
    "learning_starts", "action_noise", "seed", "num_timesteps",
)  # fmt: skip


def cost_part(subject: Subject) -> Part:
    """Return how long a call takes on this machine, and how large things are."""
    space, policy = subject.policy.observation_space, subject.policy
    observation = np.zeros(space.shape or (1,), space.dtype)
    theta = np.zeros(subject.problem.n_theta)
    looked, policy.looked = policy.looked, True  # no observation of the env
    rows = [
        ["model.predict, one observation", *_times(lambda: subject.model.predict(observation))],
        ["the MPC's law, one theta", *_times(lambda: subject.law(theta))],
    ]
    policy.looked = looked
    law = subject.law
    arrays = law.packed if isinstance(law, PiecewiseAffine) else ()
    tensors = policy.actor.state_dict().values()
    stored = _bytes(sum(each.numel() * each.element_size() for each in tensors))
    sizes = [["the actor's weights and constants", stored]]
    if arrays:
        sizes.append(["the law, with its search tree", _bytes(sum(a.nbytes for a in arrays))])
    if (peak := _peak()) is not None:
        sizes.append(["this process at its largest", _bytes(peak)])
    said = f"{CALLS} calls each, one after the other, at the operating point, on this machine."
    head = ["what", "median (µs)", "99 % are below (µs)"]
    return Part("Timing and memory", join([say(said), table(head, rows),
                                           table(["what", "size"], sizes)]))  # fmt: skip


def _times(call: Callable[[], Any]) -> tuple[str, str]:
    call()
    taken = []
    for _ in range(CALLS):
        begun = perf_counter()
        call()
        taken.append(1e6 * (perf_counter() - begun))
    return f"{np.median(taken):.1f}", f"{np.percentile(taken, 99):.1f}"


def _bytes(size: float) -> str:
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.4g} {unit}"
        size /= 1000
    return f"{size:.4g} GB"


def _peak() -> float | None:
    """Return the largest memory of the process so far in bytes, None on Windows."""
    if sys.platform == "win32":
        return None
    import resource

    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(largest if sys.platform == "darwin" else 1024 * largest)


def again_part(subject: Subject) -> Part:
    """Return versions, seeds, settings and fingerprints."""
    model = subject.model
    versions = [["Python", platform.python_version()]]
    versions += [[name, _version(name)] for name in LIBRARIES]
    versions.append(["system", f"{platform.system()} {platform.machine()}"])
    own = {name: getattr(model, name, None) for name in SETTINGS}
    rows = [[name.replace("_", " "), _in_words(value)] for name, value in own.items()]
    kwargs = {k: v for k, v in model.policy_kwargs.items() if k != "problem"}
    rows += [[f"policy: {name}", _in_words(value)] for name, value in kwargs.items()]
    prints = [
        ["the policy's weights", fingerprint(subject.policy.actor.state_dict())],
        ["the MPC problem", _problem_print(subject)],
    ]
    code = _same_report(subject)
    parts = [
        tag("h3", "Versions"), table(["library", "version"], versions),
        tag("h3", f"Settings of the {type(model).__name__}"), table(["setting", "value"], rows),
        tag("h3", "Fingerprints (SHA-256)"), table(["what", "fingerprint"], prints),
        tag("h3", "The same report"), lines(code),
    ]  # fmt: skip
    return Part("To do it again", join(parts))


def _same_report(subject: Subject) -> str:
    """Return code that writes the report again.

    What cannot be written as code stands there by its name, and a comment says what it is.
    """
    model = type(subject.model).__name__
    imports = ["from sb3_yann import report"]
    named = [f"model: the {model} of these fingerprints, by {model}.load(...)"]
    words = ["model"]
    for name, value in subject.call.items():
        if name == "seeds":
            words.append(f"seeds={_seeds(subject.seeds)}")
            continue
        text, module, told = _as_code(name, value, subject)
        words.append(text if name == "path" else f"{name}={text}")
        imports += [module] if module else []
        named += [told] if told else []
    comments = [f"# {_one_line(each)}" for each in named]
    return "\n".join([*sorted(imports, key=len), "", *comments, f"report({', '.join(words)})"])


def _as_code(name: str, value: Any, subject: Subject) -> tuple[str, str, str]:
    """Return an argument as code, the import that it takes, and what to say where it is none."""
    if isinstance(value, str | PathLike):
        return repr(fspath(value)), "", ""
    if subject.twin is not None and value == subject.twin.env:
        return "twin.env", "", ""
    module, own = getattr(value, "__module__", ""), getattr(value, "__qualname__", "")
    if callable(value) and own.isidentifier() and module != "__main__":
        if getattr(sys.modules.get(module), own, None) is value:
            return own, f"from {module} import {own}", ""
    what = name_of(value) if name == "env" else repr(value)
    if " at 0x" in what:  # an address, which says nothing
        what = f"the {type(value).__name__} of then"
    return name, "", f"{name}: {what}, which cannot be written here: make it as you did"


def _seeds(seeds: tuple[int, ...]) -> str:
    whole = range(seeds[0], seeds[0] + len(seeds))
    return repr(whole if seeds == tuple(whole) else [*seeds])


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _problem_print(subject: Subject) -> str:
    problem, found = subject.problem, hashlib.sha256()
    program = problem.condensed()
    arrays = [program.H, program.F, program.c, program.G, program.w, program.S]
    arrays += [] if program.feedback is None else [program.feedback]
    for each in (
        *arrays,
        problem.deviations.theta_min,
        problem.deviations.theta_max,
        problem.theta_ss,
    ):
        found.update(np.ascontiguousarray(each).tobytes())
    return found.hexdigest()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _in_words(value: Any) -> str:
    if isinstance(value, TrainFreq):
        return f"{value.frequency} {value.unit.value}"
    if callable(value):
        return getattr(value, "__name__", type(value).__name__)
    return str(value)
