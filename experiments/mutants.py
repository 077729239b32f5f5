"""Mutation testing on a random sample: `python experiments/mutants.py --count 50`.

One operator, number, comparison or flag of `control/`, `networks/`, `guard/` or `twin/` is changed
(Cosmic Ray's operators: `pip install cosmic-ray`), and those tests are asked that run the line,
of all that are not slow; which these are is measured first, by coverage, in some minutes. A mutant
that they pass is a survivor, also where they are not through after `--patience` seconds of one
core; a test that takes two minutes counts as failed. Run it in a checkout of its own: it changes
files there. It forks, so it needs Linux or macOS.

Left out: annotations, lines that no test runs but by importing them, and the compiled loops, whose
answers are compared with the layers' to the last bit.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import difflib
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from cosmic_ray.ast import get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names
from coverage import CoverageData

ROOMS = ("control", "networks", "guard", "twin")
PACKAGE = Path("sb3_yann")
TESTS = Path("tests")
FOLDERS = ("control", "networks", "guard", "twin", "policy", "audit")
"""Of the tests that are asked."""
ARITHMETIC = "Add|Sub|Mul|Div"
ORDER = "Eq|NotEq|Lt|LtE|Gt|GtE"
OPERATORS = re.compile(
    rf"core/(ReplaceBinaryOperator_({ARITHMETIC})_({ARITHMETIC})|ReplaceComparisonOperator_({ORDER})_"
    rf"({ORDER})|\w+_(BitAnd_BitOr|BitOr_BitAnd|Is_IsNot|IsNot_Is)|ReplaceUnaryOperator_Delete_\w+|"
    "AddNot|ReplaceTrueWithFalse|ReplaceFalseWithTrue|ReplaceAndWithOr|ReplaceOrWithAnd|"
    "NumberReplacer|ZeroIterationForLoop|ReplaceContinueWithBreak|ReplaceBreakWithContinue)"
)
HANGS, ENDS = "faulthandler_timeout=120", "faulthandler_exit_on_timeout=true"
COMPILED = re.compile("kernels|search_tree")


@dataclass
class Mutant:
    """A change of one place, and what became of it."""

    room: str
    module: str
    line: int
    change: str
    outcome: str = ""
    seconds: float = 0.0


def main(arguments: Sequence[str] | None = None) -> None:
    """Try mutants of each room, append each to a file of JSON lines, and print the shares."""
    parser = argparse.ArgumentParser(prog="python experiments/mutants.py", description=__doc__)
    parser.add_argument("--count", type=int, default=50, help="mutants of each room")
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=ROOMS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--patience", type=int, default=100, help="seconds of one core a mutant")
    parser.add_argument("--results", type=Path, default=Path("out/mutants.jsonl"))
    options = parser.parse_args(arguments)
    options.results.parent.mkdir(parents=True, exist_ok=True)
    _load_what_tests_need()
    counts: dict[str, Counter[str]] = {room: Counter() for room in options.rooms}
    if _tested(["tests/networks/test_yann.py"], 300) != "survived":
        raise SystemExit("The tests fail before anything is changed: run them by themselves.")
    runs = who_runs_what(options.results.with_suffix(".coverage"))
    drawn = {room: mutants(room, random.Random(options.seed)) for room in options.rooms}
    for _ in range(options.count):
        for room, some in drawn.items():
            mutant, code, tests = next(
                (*each, tests) for each in some if (tests := of_line(runs, each[0]))
            )
            attempt(mutant, code, tests, options.patience)
            counts[room][mutant.outcome] += 1
            with options.results.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(mutant)) + "\n")
            print(mutant.room, mutant.module, mutant.line, mutant.outcome, flush=True)
    for room, found in counts.items():
        print(room, dict(found), f"{found['killed'] / max(found.total(), 1):.0%} killed")


def mutants(room: str, rng: random.Random) -> Iterator[tuple[Mutant, str]]:
    """Yield changes of random places of a room, each with the module's code after it."""
    modules = sorted(
        each for each in (PACKAGE / room).rglob("*.py") if not COMPILED.search(str(each))
    )
    places = []
    for module in modules:
        tree = get_ast(module.read_text(encoding="utf-8"))
        for name in operator_names():
            if OPERATORS.fullmatch(name):
                operator = get_operator(name)
                found = list(_positions(tree, operator))
                places += [(module, at, name, k) for k, at in enumerate(found)]
    by_place: dict[tuple[Path, tuple[int, int]], list[tuple[str, int]]] = {}
    for module, at, name, k in places:
        by_place.setdefault((module, at), []).append((name, k))
    order = sorted(by_place, key=str)
    rng.shuffle(order)
    print(f"{room}: {len(places)} mutants at {len(order)} places", flush=True)
    for module, at in order:
        name, k = rng.choice(by_place[module, at])
        code = module.read_text(encoding="utf-8")
        changed = mutate_code(code, get_operator(name)(), k)
        if changed and _bare(changed) != _bare(code):
            difference = list(difflib.unified_diff(code.splitlines(), changed.splitlines(), n=0))
            yield Mutant(room, str(module), at[0], "\n".join(difference[3:])), changed


def _positions(tree: object, operator: type) -> Iterator[tuple[int, int]]:
    nodes = [tree]
    made = operator()
    while nodes:
        node = nodes.pop(0)
        for start, _ in made.mutation_positions(node):
            yield start
        nodes[:0] = getattr(node, "children", [])


def _bare(code: str) -> str:
    """Return the syntax tree without annotations, which change nothing at run time."""

    class Strip(ast.NodeTransformer):
        def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
            self.generic_visit(node)
            node.annotation = ast.Constant(None)
            return node

        def visit_arg(self, node: ast.arg) -> ast.AST:
            node.annotation = None
            return node

        def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
            self.generic_visit(node)
            node.returns = None
            return node

        def visit_If(self, node: ast.If) -> ast.AST:
            self.generic_visit(node)
            if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
                return ast.Pass()
            return node

    try:
        return ast.dump(Strip().visit(ast.parse(code)))
    except SyntaxError:
        return code


def attempt(mutant: Mutant, code: str, tests: Sequence[str], patience: int) -> None:
    """Let the tests meet a mutant, in a process of their own."""
    module = Path(mutant.module)
    original = module.read_text(encoding="utf-8")
    began = time.monotonic()
    try:
        module.write_text(code, encoding="utf-8")
        mutant.outcome = _tested(tests, patience)
    finally:
        module.write_text(original, encoding="utf-8")
    mutant.seconds = round(time.monotonic() - began, 1)


def who_runs_what(data: Path) -> CoverageData:
    """Return which tests run which lines; measured if the file is not there."""
    if not data.exists():
        settings = data.with_suffix(".ini")
        settings.write_text("[run]\ndynamic_context = test_function\n", encoding="utf-8")
        folders = [str(TESTS / name) for name in FOLDERS]
        how = ["-m", "coverage", "run", f"--rcfile={settings}", f"--data-file={data}"]
        tests = ["-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider", *folders]
        subprocess.run([sys.executable, *how, f"--source={PACKAGE}", *tests], check=True)
    found = CoverageData(str(data))
    found.read()
    return found


def of_line(runs: CoverageData, mutant: Mutant, length: int = 12) -> list[str]:
    """Return the tests that run a line, or the beginning of its statement; nearest files first."""
    contexts = runs.contexts_by_lineno(str(Path(mutant.module).resolve()))
    lines = range(mutant.line, max(0, mutant.line - length), -1)
    tests = next((found for line in lines if (found := {*contexts.get(line, ())} - {""})), set())
    files = {file.stem: file for file in TESTS.rglob("test_*.py")}
    stem = Path(mutant.module).stem.strip("_")

    def near(test: str) -> tuple[bool, str]:
        return stem not in test.split(".")[0], test

    found = [each.split(".") for each in sorted(tests, key=near)]
    return [f"{files[name]}::{'::'.join(rest)}" for name, *rest in found if name in files]


def _tested(tests: Sequence[str], patience: int) -> str:
    child = os.fork()
    if not child:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_CPU, (patience, patience + 5))
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        import pytest

        options = ["-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", "-o", HANGS, "-o", ENDS]
        os._exit(pytest.main([*options, *tests]))
    _, status = os.waitpid(child, 0)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what it has left running
    code = os.waitstatus_to_exitcode(status)
    return {0: "survived", -signal.SIGXCPU: "survived so far"}.get(code, "killed")


def _load_what_tests_need() -> None:
    """Import slow libraries once, for all children: none that loads sb3_yann, nor pytest."""
    sys.path[:1] = [os.getcwd(), "tests"]
    sys.dont_write_bytecode = True  # two mutants of one size within a second look alike
    import numba  # noqa: F401
    import ppopt.mplp_program  # noqa: F401
    import scipy.optimize  # noqa: F401
    import torch

    torch.set_num_threads(1)
    loaded = [name for name in sys.modules if name.startswith("sb3_yann")]
    if loaded:
        raise SystemExit(f"{loaded[0]} is loaded already: the tests would not meet the mutants.")


if __name__ == "__main__":
    main()
