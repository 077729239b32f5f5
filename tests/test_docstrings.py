"""The examples in the docstrings run; what is public has one, and names its parameters."""

import doctest
import importlib
import importlib.util
import inspect
import pkgutil
import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from improvement_samples import quickest
from sb3_yann.twin import plant_twin

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
    """Yield the names of all modules of the packages."""
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


def public_callables() -> dict[str, tuple[Callable[..., Any], str]]:
    """Return what the packages export, functions, methods and constructors, with docstrings."""
    found: dict[str, tuple[Callable[..., Any], str]] = {}
    for name, value in exported().items():
        if inspect.isclass(value):
            found |= methods(name, value)
        else:
            found[name] = value, value.__doc__ or ""
    return found


def methods(path: str, owner: type) -> dict[str, tuple[Callable[..., Any], str]]:
    """Return a class's own public methods, and its constructor with the docstring of the class."""
    found: dict[str, tuple[Callable[..., Any], str]] = {}
    for name, value in vars(owner).items():
        method = value.__func__ if isinstance(value, classmethod | staticmethod) else value
        if not inspect.isfunction(method) or (name.startswith("_") and name != "__init__"):
            continue
        text = method.__doc__ or ""
        if name == "__init__":
            text += owner.__doc__ or ""
        elif inherited(owner, name):
            continue  # the signature, and with it the documentation, is another library's
        found[f"{path}.{name}"] = method, text
    return found


def inherited(owner: type, name: str) -> bool:
    return any(name in vars(base) for base in owner.__mro__[1:])


def undocumented(function: Callable[..., Any], text: str) -> list[str]:
    """Return the parameters that no line of a Parameters or Attributes section begins with."""
    given = [
        each.name
        for each in inspect.signature(function).parameters.values()
        if each.name not in ("self", "cls")
        and each.kind not in (each.VAR_KEYWORD,)
        and not each.name.startswith("_")  # what `dataclasses.replace` passes
    ]
    if len(given) < MANY:
        return []
    named: set[str] = set()
    for body in re.findall(
        r"^(Parameters|Attributes)\n-+\n(.*?)(?=^\w[\w ]*\n-+\n|\Z)",
        inspect.cleandoc(text),
        re.MULTILINE | re.DOTALL,
    ):
        for line in body[1].splitlines():
            if not line.startswith(" "):
                named |= set(re.findall(r"\w+", line.partition(" : ")[0]))
    return [name for name in given if name not in named]


@pytest.mark.parametrize("example", with_examples(), ids=lambda example: example.name)
def test_the_examples_of_a_docstring_run(example: doctest.DocTest, monkeypatch, tmp_path) -> None:
    for module, library in OPTIONAL.items():
        if example.name.startswith(f"{module}.") and importlib.util.find_spec(library) is None:
            pytest.skip(f"{library} is not installed")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plant_twin, "LONG_LOG", 10**9)  # a fit of networks takes seconds
    quickest(monkeypatch)
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


CALLABLES = public_callables()
LONG = [
    name for name, (function, _) in CALLABLES.items() if len(undocumented(function, "")) >= MANY
]


@pytest.mark.parametrize("name", LONG)
def test_many_parameters_are_documented_by_name(name: str) -> None:
    assert undocumented(*CALLABLES[name]) == []
