"""The examples in the docstrings run; what is public has one, and names its parameters."""

import doctest
import importlib
import importlib.util
import inspect
import pkgutil
import re
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import pytest

from improvement_samples import quickest

PACKAGES = ("sb3_yann", "sb3_yann_envs")
EXPORTING = (
    "sb3_yann",
    "sb3_yann.control",
    "sb3_yann.networks",
    "sb3_yann.wrappers",
    "sb3_yann.evaluation",
    "sb3_yann_envs",
)
MANY = 4
"""Parameters from which on each is documented."""
OPTIONAL = {"sb3_yann_envs.pcgym": "pcgym"}
"""Modules whose examples need a library that `make` does not install."""
FINDER = doctest.DocTestFinder(exclude_empty=True)


def modules() -> Iterator[str]:
    for package in PACKAGES:
        yield package
        found = pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}.")
        yield from (each.name for each in found)


MODULES = [importlib.import_module(name) for name in modules()]


def with_examples() -> list[doctest.DocTest]:
    """Return the docstrings of the packages that hold examples, a module's objects in order."""
    tests = [each for module in MODULES for each in FINDER.find(module, module.__name__)]
    return [each for each in tests if each.examples]


def exported() -> dict[str, Any]:
    """Return the classes and functions that the packages export, by their names."""
    found = {}
    for package in map(importlib.import_module, EXPORTING):
        for name in public_names(package):
            value = getattr(package, name)
            if inspect.isclass(value) or inspect.isroutine(value):
                found[f"{package.__name__}.{name}"] = value
    return found


def public_names(module: Any) -> list[str]:
    """Return ``__all__``, or else what is public and of the module itself."""
    own = [
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and getattr(value, "__module__", None) == module.__name__
    ]
    return list(getattr(module, "__all__", own))


def undocumented(function: Callable[..., Any], text: str) -> list[str]:
    """Return the parameters that no line of the text but those of an example begins with."""
    given = inspect.signature(function).parameters.values()
    own = [each.name for each in given if each.kind is not each.VAR_KEYWORD]
    own = [name for name in own if name not in ("self", "cls") and not name.startswith("_")]
    lines = re.findall(r"^[\w*][\w, *]*(?= : |$)", inspect.cleandoc(text), re.MULTILINE)
    named = set(re.findall(r"\w+", " ".join(lines)))
    return [name for name in own if name not in named] if len(own) >= MANY else []


def callables() -> dict[str, tuple[Callable[..., Any], str]]:
    """Return exported functions, constructors and methods that are no override, with texts."""
    found: dict[str, tuple[Callable[..., Any], str]] = {}
    for path, thing in exported().items():
        if not inspect.isclass(thing):
            found[path] = thing, thing.__doc__ or ""
            continue
        for name, value in vars(thing).items():
            method = getattr(value, "__func__", value)
            text = inspect.cleandoc(getattr(method, "__doc__", None) or "")
            if name == "__init__":
                text += "\n" + inspect.cleandoc(thing.__doc__ or "")
            inherited = any(name in vars(base) for base in thing.__mro__[1:])
            own = name == "__init__" or not (name.startswith("_") or inherited)
            if inspect.isfunction(method) and own:
                found[f"{path}.{name}"] = method, text
    return found


@pytest.mark.parametrize("example", with_examples(), ids=lambda example: example.name)
def test_the_examples_of_a_docstring_run(example: doctest.DocTest, monkeypatch, tmp_path) -> None:
    for module, library in OPTIONAL.items():
        if example.name.startswith(f"{module}.") and importlib.util.find_spec(library) is None:
            pytest.skip(f"{library} is not installed")
    monkeypatch.chdir(tmp_path)
    quickest(monkeypatch)
    if " improve(" in (example.docstring or ""):
        monkeypatch.setattr(gym.registry["CSTR-v0"], "max_episode_steps", 60)
    found = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(example)
    assert found.attempted and not found.failed, "\n" + (example.docstring or "")


def is_raised(thing: Any) -> bool:
    return isinstance(thing, type) and issubclass(thing, BaseException)


# What is raised is not called: its message is the example.
@pytest.mark.parametrize("name", [k for k, thing in exported().items() if not is_raised(thing)])
def test_what_is_exported_has_examples(name: str) -> None:
    thing = exported()[name]
    own = vars(thing).get("__doc__") if isinstance(thing, type) else thing.__doc__
    text = inspect.cleandoc(own or "")
    assert re.search(r"^Examples\n--------\n", text, re.MULTILINE) and ">>> " in text


CALLABLES = callables()
LONG = [
    name for name, (function, _) in CALLABLES.items() if len(undocumented(function, "")) >= MANY
]


@pytest.mark.parametrize("name", LONG)
def test_many_parameters_are_documented_by_name(name: str) -> None:
    assert undocumented(*CALLABLES[name]) == []
