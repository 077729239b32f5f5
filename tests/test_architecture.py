"""No circle of files, no import against the direction of the house, walls that hold at run time."""

import ast
import os
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import sb3_yann
from fresh_process import run_python

ROOT = Path(__file__).parents[1]
PACKAGES = {"sb3_yann": ROOT, "sb3_yann_envs": ROOT / "envs"}

FLOORS = [
    {"sb3_yann._archive", "sb3_yann._validation"},
    {"sb3_yann._progress"},
    {"sb3_yann._numba"},
    {"sb3_yann.log", "sb3_yann.units"},
    {"sb3_yann.control"},
    {"sb3_yann.compare"},
    {"sb3_yann.env_pool"},
    {"sb3_yann.rollout"},
    {"sb3_yann_envs"},
    {"sb3_yann.evaluation"},
    {"sb3_yann.networks"},
    {"sb3_yann.twin"},
    {"sb3_yann.plan"},
    {"sb3_yann.policy"},
    {"sb3_yann.callbacks", "sb3_yann.wrappers"},
    {"sb3_yann.audit"},
    {"sb3_yann.guard"},
    {"sb3_yann.deployment", "sb3_yann.tuning"},
    {"sb3_yann.improvement"},
    {"sb3_yann.commissioning"},
    {"sb3_yann.reporting"},
    {"sb3_yann"},
    {"sb3_yann.cli"},
    {"sb3_yann.__main__"},
]
"""Each floor may import from those before it. `sb3_yann` itself only names what there is."""

SB3 = {"stable_baselines3", "sb3_contrib", "rl_zoo3"}
LIGHT = {"torch", "stable_baselines3", "gymnasium"}
FORBIDDEN = {
    "sb3_yann._archive": {*LIGHT, "numba", "scipy", "sb3_yann"},
    "sb3_yann._validation": LIGHT,
    "sb3_yann._progress": LIGHT,
    "sb3_yann._numba": LIGHT,
    "sb3_yann.units": LIGHT,
    "sb3_yann.control": {"torch", *SB3},
    "sb3_yann.networks": {*SB3, "gymnasium", "sb3_yann_envs"},
    "sb3_yann_envs": {"torch", *SB3},
}
"""Libraries of a floor above. The networks know no plant either, though its floor is below."""


def _modules() -> dict[str, Path]:
    found = {}
    for package, root in PACKAGES.items():
        for path in sorted((root / package).rglob("*.py")):
            name = ".".join(path.relative_to(root).with_suffix("").parts)
            found[name.removesuffix(".__init__")] = path
    return found


MODULES = _modules()


def _imports(name: str) -> set[str]:
    """Return what a module imports anywhere: in functions and for type checkers too."""
    found = set()
    package = name if MODULES[name].stem == "__init__" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(MODULES[name].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package.split(".")[: len(package.split(".")) - node.level + 1])
            module = ".".join(filter(None, [base if node.level else "", node.module]))
            for alias in node.names:
                whole = f"{module}.{alias.name}"
                found.add(whole if whole in MODULES else module)
    return found


IMPORTS = {name: _imports(name) for name in MODULES}


def _room(name: str) -> str:
    """Return the part of the house that a module belongs to."""
    head, *rest = name.split(".")
    return f"{head}.{rest[0]}" if head == "sb3_yann" and rest else head


def _floor(name: str) -> int:
    return next(i for i, rooms in enumerate(FLOORS) if _room(name) in rooms)


def test_no_files_import_each_other_in_a_circle() -> None:
    own = {name: found & MODULES.keys() - {name} for name, found in IMPORTS.items()}
    TopologicalSorter(own).prepare()  # raises a CycleError that names the circle


def test_every_module_has_a_floor() -> None:
    assert [name for name in MODULES if not any(_room(name) in rooms for rooms in FLOORS)] == []


def test_no_import_goes_up_nor_to_another_room_of_the_same_floor() -> None:
    against = [
        f"{name} imports {other}"
        for name, found in IMPORTS.items()
        for other in sorted(found & MODULES.keys())
        if _floor(other) >= _floor(name) and _room(other) != _room(name)
    ]
    assert against == []


@pytest.mark.parametrize("room", FORBIDDEN)
def test_a_lower_floor_imports_no_library_of_a_higher_one(room: str) -> None:
    against = [
        f"{name} imports {library}"
        for name, found in IMPORTS.items()
        for library in sorted({each.partition(".")[0] for each in found} & FORBIDDEN[room])
        if _room(name) == room
    ]
    assert against == []


LOADED = "; import sys; print(sorted({'torch', 'stable_baselines3'} & sys.modules.keys()))"


@pytest.mark.parametrize(
    "code",
    [
        "import sb3_yann",
        "import sb3_yann.control",
        "from sb3_yann import Controller",
        "import gymnasium, sb3_yann_envs; "
        "gymnasium.make('CSTR-v0').observation_space.problem.explicit()",
    ],
)
def test_the_design_side_loads_neither_torch_nor_stable_baselines3(code: str) -> None:
    assert run_python(code + LOADED) == ("[]\n", "")


@pytest.mark.slow
def test_the_alias_is_known_after_a_look_for_stable_baselines3_too() -> None:
    """It is in both orders of imports: WORK and test_progress use it."""
    code = """
import importlib.util, sb3_yann
importlib.util.find_spec("stable_baselines3")
from stable_baselines3.ddpg import DDPG
print(DDPG.policy_aliases["YannPolicy"].__name__)
"""
    assert run_python(code) == ("YannPolicy\n", "")


def test_names_for_type_checkers_are_those_that_are_loaded() -> None:
    stub = Path(sb3_yann.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    imports = [node for node in ast.parse(stub).body if isinstance(node, ast.ImportFrom)]
    shown = {alias.name: node.module for node in imports for alias in node.names}
    assert shown == sb3_yann._HOMES
    assert all(getattr(sb3_yann, name) is not None for name in sb3_yann.__all__)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        sb3_yann.nothing  # noqa: B018


def _packed(tree: ast.AST) -> list[int]:
    """Return the lines of assignments that do in one statement what two would do."""
    return [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign)
        and len(node.targets) == 1
        and isinstance(node.targets[0], ast.Tuple)
        and isinstance(node.value, ast.Tuple)
        and not any(isinstance(each, ast.Starred) for each in node.value.elts)
        and not {ast.unparse(each) for each in node.targets[0].elts} & _read(node.value)
    ]


def _read(value: ast.AST) -> set[str]:
    """Return all names, attributes and entries that an expression reads."""
    return {ast.unparse(each) for each in ast.walk(value) if isinstance(each, ast.expr)}


def test_a_statement_assigns_one_thing_but_for_swaps() -> None:
    assert _packed(ast.parse("a, b = x, y")) == [1]
    assert not _packed(ast.parse("a, b = b, a\na, b = pair"))
    found = {
        name: lines
        for name, path in MODULES.items()
        if (lines := _packed(ast.parse(path.read_text(encoding="utf-8"))))
    }
    assert found == {}


# ---- A law is solved and a policy learns where there is no home to keep anything in ----


WORK = """
import torch
torch.set_num_threads(1)
from stable_baselines3 import DDPG
from sb3_yann import ImprovementGuard, NoActionNoise
from sb3_yann.evaluation.plots import plot_regions
from sb3_yann_envs import problems
plot_regions(problems.clipped_pendulum()).figure.savefig("law.png")
options = {"critic_warmup": 50}
model = DDPG("YannPolicy", "CSTR-v0", device="cpu", seed=0, policy_kwargs=options)
guard = ImprovementGuard("CSTR-v0", n_eval_episodes=2, n_new_starts=2, n_final_starts=2)
model.learn(120, callback=[NoActionNoise(), guard])
print(model.num_timesteps)
"""


@pytest.mark.nightly
@pytest.mark.skipif(os.name != "posix", reason="a home of its own kind")
def test_it_works_without_a_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    for name in [name for name in os.environ if name.startswith(("XDG_", "MPLC"))]:
        monkeypatch.delenv(name)
    home = str(tmp_path / "file" / "home")
    printed, _ = run_python(WORK, folder=tmp_path, HOME=home, MPLBACKEND="Agg")
    assert printed == "120\n"
    assert (tmp_path / "law.png").exists()
