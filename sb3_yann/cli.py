"""The command ``sb3-yann``: its arguments, what each command does, its errors and exit codes.

Each command imports what it uses.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import zipfile
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sb3_yann import __version__
from sb3_yann._progress import answer, say
from sb3_yann._validation import check_int, message_of


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command, and return the exit code: 0, 1 for an error, 130 for Ctrl-C."""
    options = _parser().parse_args(arguments)
    if os.getcwd() not in sys.path:  # modules of the user's, as with python -m
        sys.path.insert(0, os.getcwd())
    try:
        options.run(options)
    except KeyboardInterrupt:
        say("Interrupted.", sys.stderr)
        return 130
    except Exception as error:
        if options.traceback:
            raise
        kind = "" if isinstance(error, OSError | TypeError | ValueError) else type(error).__name__
        message = f"{kind}{': ' * bool(kind)}{message_of(error)}"
        say(f"sb3-yann {options.command}: {message}", sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    problem = 'a registered problem ("CSTR-v0") or "module:attribute", a LinearMPC of your own'
    env = 'the plant: the id of an environment, or "module:attribute", a function that makes one'
    model = "a model that model.save(path) has written"
    found = argparse.ArgumentParser(
        prog="sb3-yann",
        description="Reinforcement learning that starts as a linear MPC, exactly.",
        epilog="Exit codes: 0 done, 1 not done (the message says why), 2 wrong arguments, "
        "130 interrupted.",
    )
    found.add_argument("--version", action="version", version=__version__)
    found.add_argument("--traceback", action="store_true", help="show where an error came from")
    commands = found.add_subparsers(dest="command", required=True, metavar="command")

    def add(name: str, run: Callable[[Namespace], None], text: str) -> argparse.ArgumentParser:
        one = commands.add_parser(name, help=text)
        one.set_defaults(run=run)
        return one

    one = add("solve", _solve, "solve a problem, describe its law, save it")
    one.add_argument("problem", help=problem)
    one.add_argument("--save", metavar="LAW.npz", help="where to write the law")
    one.add_argument("--time-limit", type=float, metavar="SECONDS", help="default: none")
    one.add_argument("--region-limit", type=int, metavar="N", help="default: none")

    one = add("plot", _plot, "draw the regions of a law")
    one.add_argument("law", help=f"a law's .npz file, {model}, or {problem}")
    one.add_argument("picture", help="where to write it: .png, .svg or .pdf")
    one.add_argument(
        "--axes",
        type=lambda given: int(given) if given.isdigit() else given,
        nargs=2,
        default=(0, 1),
        metavar=("I", "J"),
        help="entries of theta: numbers, or names of states",
    )

    one = add("evaluate", _evaluate, "play episodes of a model and of its MPC")
    one.add_argument("model", help=model)
    one.add_argument("--env", required=True, help=env)
    one.add_argument("--episodes", type=int, default=20, metavar="N", help="default: 20")
    one.add_argument("--seed", type=int, default=0, help="of the first episode; default: 0")

    one = add("report", _report, "write a report that can be signed")
    one.add_argument("model", help=model)
    one.add_argument("page", help="where to write it: .html")
    one.add_argument("--env", help=f"{env}; without it nothing is played")
    one.add_argument("--episodes", type=int, default=20, metavar="N", help="default: 20")
    one.add_argument("--seed", type=int, default=0, help="of the first episode; default: 0")

    one = add("export", _export, "write a controller: C code, a function block, ...")
    one.add_argument("law", help=f"{model}, a law's .npz file, or {problem}")
    one.add_argument("path", help="where to write it: .c, .npz, .onnx, .st, .xml (PLCopen) or .fmu")
    one.add_argument("--name", help="prefix of all names in code; default: the file's")
    one.add_argument("--float", action="store_true", help="code in single precision")
    one.add_argument(
        "--checks", metavar="FILE.json", help="limits of readings, and how to fall back"
    )
    one.add_argument(
        "--estimator", choices=("caller",), help="your code runs the estimator of disturbances"
    )

    one = add("commission", _commission, "improve a model on its plant, batch by batch")
    one.add_argument("model", help=model)
    one.add_argument("--env", required=True, help=env)
    one.add_argument("--record", required=True, metavar="FOLDER", help="goes on where it ended")
    one.add_argument("--batches", type=int, default=3, metavar="N", help="in all; default: 3")
    one.add_argument("--batch", type=int, default=4, metavar="N", help="episodes of the first one")
    one.add_argument("--max-correction", type=float, default=0.1, metavar="SHARE")
    one.add_argument("--shadow", action="store_true", help="the MPC acts; the policy only computes")
    one.add_argument("--save", metavar="MODEL.zip", help="where to write the accepted model")
    return found


# ---- What each command does ----


def _solve(options: Namespace) -> None:
    if options.save:  # what takes long is not done in vain
        path = Path(options.save)
        if path.is_dir():
            raise IsADirectoryError(f"{path} is a folder; name a file in it.")
        if path.suffix != ".npz":
            raise ValueError(f"--save {path}: a law is written as .npz, by which it is known.")
        if not path.parent.is_dir():
            raise FileNotFoundError(f"There is no folder {path.parent}: make it first.")
    problem = _problem(options.problem)
    law = problem.explicit(time_limit=options.time_limit, region_limit=options.region_limit)
    answer(problem.report())
    if options.save:
        law.save(options.save)
        answer(f"Written: {options.save}")


def _evaluate(options: Namespace) -> None:
    """Play the same episodes with a model's MPC and with the model, and print how they compare."""
    from sb3_yann import evaluation

    seeds = _seeds(options.episodes, options.seed)
    model = _model(options.model)
    policy = evaluation.evaluate(model, options.env, seeds)
    model.policy.limit_correction(0.0)  # what is left is the MPC
    mpc = evaluation.evaluate(model, options.env, seeds)
    title = f"{options.episodes} episodes from seed {options.seed}: the MPC, and {options.model}"
    answer(evaluation.comparison_table(title, mpc, policy))


def _plot(options: Namespace) -> None:
    from sb3_yann.control.law_plot import new_figure, save_figure

    figure = new_figure()
    _law(options.law).plot(figure.subplots(), entries=tuple(options.axes))
    answer(f"Written: {save_figure(figure, options.picture, dpi=150)}")


def _report(options: Namespace) -> None:
    from sb3_yann import report as write

    seeds = _seeds(options.episodes, options.seed)
    answer(f"Written: {write(_model(options.model), options.page, env=options.env, seeds=seeds)}")


def _export(options: Namespace) -> None:
    from sb3_yann import export as write

    read = _model if _is_model(options.law) else _problem
    if Path(options.law).suffix == ".npz":
        read = _law
    written = write(
        read(options.law),
        options.path,
        name=options.name,
        precision="float" if options.float else "double",
        checks=_checks(options.checks),
        estimator=options.estimator,
    )
    answer(f"Written: {written}")


def _commission(options: Namespace) -> None:
    from sb3_yann import Commissioning

    model = _model(options.model)
    found = Commissioning(
        model,
        options.env,
        batch=options.batch,
        max_correction=options.max_correction,
        log_path=options.record,
        shadow=options.shadow,
        verbose=1,
    )
    found.run(options.batches)
    answer(found.report())
    if options.save:
        model.save(options.save)
        answer(f"Written: {options.save}")


# ---- What an argument stands for ----


def _problem(given: str) -> Any:
    """Return the LinearMPC that a name or ``"module:attribute"`` stands for."""
    from sb3_yann.policy.checks import resolve_problem

    return resolve_problem(given, None)


def _model(path: str) -> Any:
    """Return a saved model.

    DDPG is TD3 with other defaults: what TD3 loads acts and learns as it was saved.
    """
    from stable_baselines3.common.save_util import load_from_zip_file

    from sb3_yann.policy.policies import StartsAsMPC

    if not Path(path).exists() and not Path(f"{path}.zip").exists():
        raise FileNotFoundError(f"There is no model {path}: model.save(path) writes one.")
    if not _is_model(path):
        raise ValueError(f"{path} is no model: pass a .zip file that model.save(path) has written.")
    data = load_from_zip_file(path, device="cpu")[0] or {}  # a wrong algorithm fails without a word
    kind = data.get("policy_class")
    if not (isinstance(kind, type) and issubclass(kind, StartsAsMPC)):
        found = kind.__name__ if isinstance(kind, type) else "nothing that is known"
        raise ValueError(
            f"{path} holds {found} as its policy: sb3-yann needs a YannPolicy. Build the model as "
            'DDPG("YannPolicy", env), and save it by model.save(path).'
        )
    return kind.ALGORITHMS[0].load(path, device="cpu")


def _checks(path: str | None) -> Any:
    """Return the options of Checks that a JSON file sets; None without one."""
    if path is None:
        return None
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is no JSON: {error}") from None


def _law(given: str) -> Any:
    """Return a law from its file, from a model, or from a problem."""
    from sb3_yann import OnlineLaw, PiecewiseAffine
    from sb3_yann.control.law import read_law

    if _is_model(given):
        policy = _model(given).policy
        return policy.problem.law(policy.law)
    if not Path(given).suffix == ".npz":
        return _problem(given).law()
    is_explicit = read_law("a law", given, lambda data: "gains" in data)
    return PiecewiseAffine.load(given) if is_explicit else OnlineLaw.load(given)


def _seeds(episodes: int, first: int = 0) -> range:
    """Return the seeds of so many episodes, one at least."""
    first = check_int("--seed", first, 0)
    return range(first, first + check_int("--episodes", episodes))


def _is_model(given: str) -> bool:
    """Tell whether a file is a model's: a zip archive that is no .npz."""
    found = given if Path(given).exists() else f"{given}.zip"  # model.save("m") writes m.zip
    return Path(found).suffix != ".npz" and zipfile.is_zipfile(found)
