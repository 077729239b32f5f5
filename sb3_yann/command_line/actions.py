"""What each command of ``sb3-yann`` does; each loads no more than it needs."""

from __future__ import annotations

import json
import zipfile
from argparse import Namespace
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any

from sb3_yann._validation import check_int


def solve(options: Namespace) -> None:
    """Solve a problem, print its report, and save the law."""
    if options.save:
        _require_place(Path(options.save))
    problem = problem_of(options.problem)
    law = problem.explicit(
        time_limit=options.time_limit, region_limit=options.region_limit, progress=True
    )
    print(problem.report())
    if options.save:
        law.save(options.save)
        print(f"Written: {options.save}")


def evaluate(options: Namespace) -> None:
    """Play the same episodes with a model's MPC and with the model, and print how they compare."""
    from rich.console import Console

    from sb3_yann import evaluation

    seeds = _seeds(options.episodes, options.seed)
    model, env = model_of(options.model), env_of(options.env)
    policy = evaluation.evaluate(model, env, seeds)
    model.policy.limit_correction(0.0)  # what is left is the MPC
    mpc = evaluation.evaluate(model, env, seeds)
    title = f"{options.episodes} episodes from seed {options.seed}: the MPC, and {options.model}"
    Console().print(evaluation.summary_table(title, mpc, policy))


def plot(options: Namespace) -> None:
    """Draw the regions of a law."""
    from sb3_yann._drawing import new_figure, save_figure

    figure = new_figure()
    law_of(options.law).plot(figure.subplots(), entries=tuple(options.axes))
    print(f"Written: {save_figure(figure, options.picture, dpi=150)}")


def report(options: Namespace) -> None:
    """Write the report on a model."""
    from sb3_yann import report as write

    seeds, env = _seeds(options.episodes), env_of(options.env) if options.env else None
    written = write(model_of(options.model), options.page, env=env, seeds=seeds)
    print(f"Written: {written}")


def export(options: Namespace) -> None:
    """Write a controller, and print what it costs."""
    from sb3_yann import export as write

    if _is_model(options.law):
        given = model_of(options.law)
    elif Path(options.law).suffix == ".npz":
        given = law_of(options.law)
    else:
        given = problem_of(options.law)
    written = write(
        given,
        options.path,
        name=options.name,
        precision="float" if options.float else "double",
        absolute=options.absolute,
        checks=checks_of(options.checks),
        observer=options.observer,
    )
    print(f"Written: {written}")


def commission(options: Namespace) -> None:
    """Run a commissioning, or go on with one, and print its batches."""
    from sb3_yann import Commissioning

    model = model_of(options.model)
    found = Commissioning(
        model,
        env_of(options.env),
        batch=options.batch,
        max_correction=options.max_correction,
        log_path=options.record,
        shadow=options.shadow,
        verbose=1,
    )
    found.run(options.batches)
    print(found.report())
    if options.save:
        model.save(options.save)
        print(f"Written: {options.save}")


def problem_of(given: str) -> Any:
    """Return the LinearMPC that a name or ``"module:attribute"`` stands for."""
    from sb3_yann.policy.checks import resolve_problem

    return resolve_problem(given, None)


def env_of(given: str) -> Any:
    """Return an env's id as it is, and what ``"module:attribute"`` names, if there is such."""
    module, _, attribute = given.partition(":")
    # "module:Env-v0" is Gymnasium's own: import the module, then look the id up.
    return getattr(import_module(module), attribute, given) if attribute else given


def model_of(path: str) -> Any:
    """Return a saved model.

    DDPG is TD3 with other defaults: what TD3 loads acts and learns as it was saved.
    """
    from stable_baselines3 import TD3
    from stable_baselines3.common.save_util import load_from_zip_file

    from sb3_yann import YannPolicy

    if not Path(path).exists() and not Path(f"{path}.zip").exists():
        raise FileNotFoundError(f"There is no model {path}: model.save(path) writes one.")
    if not _is_model(path):
        raise ValueError(f"{path} is no model: pass a .zip file that model.save(path) has written.")
    data = load_from_zip_file(path, device="cpu")[0] or {}  # TD3 fails at others' without a word
    kind = data.get("policy_class")
    if not (isinstance(kind, type) and issubclass(kind, YannPolicy)):
        found = kind.__name__ if isinstance(kind, type) else "nothing that is known"
        raise ValueError(
            f"{path} holds {found} as its policy: sb3-yann needs a YannPolicy. Build the model as "
            'DDPG("YannPolicy", env), and save it by model.save(path).'
        )
    return TD3.load(path, device="cpu")


def checks_of(path: str | None) -> Any:
    """Return the Checks that a JSON file sets; None without one."""
    if path is None:
        return None
    from sb3_yann import Checks

    try:
        given = json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is no JSON: {error}") from None
    known = [each.name for each in fields(Checks)]
    if not isinstance(given, dict) or not set(given) <= set(known):
        raise ValueError(
            f"{path} must be an object with some of {', '.join(known)}; it holds {given!r}."
        )
    return Checks(**given)


def law_of(given: str) -> Any:
    """Return a law from its file, from a model, or from a problem."""
    from sb3_yann import OnlineLaw, PiecewiseAffine
    from sb3_yann.control.law import read_law

    if _is_model(given):
        policy = model_of(given).policy
        return policy.problem.law(policy.law)
    if not Path(given).suffix == ".npz":
        return problem_of(given).law()
    is_explicit = read_law("a law", given, lambda data: "gains" in data)
    return PiecewiseAffine.load(given) if is_explicit else OnlineLaw.load(given)


def _seeds(episodes: int, first: int = 0) -> range:
    """Return the seeds of so many episodes, one at least."""
    first = check_int("--seed", first, 0)
    return range(first, first + check_int("--episodes", episodes))


def _require_place(path: Path) -> None:
    """Raise unless a file can lie there: what takes long is not done in vain."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; name a file in it.")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"There is no folder {path.parent}: make it first.")


def _is_model(given: str) -> bool:
    """Tell whether a file is a model's: a zip archive that is no .npz."""
    found = given if Path(given).exists() else f"{given}.zip"  # model.save("m") writes m.zip
    return Path(found).suffix != ".npz" and zipfile.is_zipfile(found)
