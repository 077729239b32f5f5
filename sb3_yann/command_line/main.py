"""The arguments of ``sb3-yann``, its errors and its exit codes."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Any

from sb3_yann import __version__
from sb3_yann.command_line import actions

FAILED, INTERRUPTED = 1, 130
"""Exit codes, beside argparse's 2: the command could not do what was asked; Ctrl-C ended it."""

_PROBLEM = 'a registered problem ("CSTR-v0") or "module:attribute", a LinearMPC of your own'
_ENV = 'the plant: the id of an environment, or "module:attribute", a function that makes one'
_MODEL = "a model that model.save(path) has written"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command, and return the exit code: 0, 1 for an error, 130 for Ctrl-C.

    Parameters
    ----------
    arguments : sequence of str, optional
        The default is the command line's.

    Examples
    --------
    >>> main(["solve", "no-such-problem"])
    1
    """
    options = parser().parse_args(arguments)
    if os.getcwd() not in sys.path:  # modules of the user's, as with python -m
        sys.path.insert(0, os.getcwd())
    try:
        options.run(options)
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if options.traceback:
            raise
        kind = "" if isinstance(error, OSError | TypeError | ValueError) else type(error).__name__
        print(f"sb3-yann {options.command}: {kind}{': ' * bool(kind)}{error}", file=sys.stderr)
        return FAILED
    return 0


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    found = argparse.ArgumentParser(
        prog="sb3-yann",
        description="Reinforcement learning that starts as a linear MPC, exactly.",
        epilog="Exit codes: 0 done, 1 not done (the message says why), 2 wrong arguments, "
        "130 interrupted.",
    )
    found.add_argument("--version", action="version", version=__version__)
    found.add_argument("--traceback", action="store_true", help="show where an error came from")
    commands = found.add_subparsers(dest="command", required=True, metavar="command")
    _add_design(commands)
    _add_plant(commands)
    return found


def _add_design(commands: Any) -> None:
    """Add the commands that need no plant."""
    one = commands.add_parser("solve", help="solve a problem, describe its law, save it")
    one.add_argument("problem", help=_PROBLEM)
    one.add_argument("--save", metavar="LAW.npz", help="where to write the law")
    one.add_argument("--time-limit", type=float, metavar="SECONDS", help="default: none")
    one.add_argument("--region-limit", type=int, metavar="N", help="default: none")
    one.set_defaults(run=actions.solve)

    one = commands.add_parser("plot", help="draw the regions of a law")
    one.add_argument("law", help=f"a law's .npz file, {_MODEL}, or {_PROBLEM}")
    one.add_argument("picture", help="where to write it: .png, .svg or .pdf")
    one.add_argument(
        "--axes", type=int, nargs=2, default=(0, 1), metavar=("I", "J"), help="coordinates of theta"
    )
    one.set_defaults(run=actions.plot)


def _add_plant(commands: Any) -> None:
    """Add the commands that play episodes."""
    one = commands.add_parser("evaluate", help="play episodes of a model and of its MPC")
    one.add_argument("model", help=_MODEL)
    one.add_argument("--env", required=True, help=_ENV)
    one.add_argument("--episodes", type=int, default=20, metavar="N", help="default: 20")
    one.add_argument("--seed", type=int, default=0, help="of the first episode; default: 0")
    one.set_defaults(run=actions.evaluate)

    one = commands.add_parser("report", help="write a report that can be signed")
    one.add_argument("model", help=_MODEL)
    one.add_argument("page", help="where to write it: .html")
    one.add_argument("--env", help=f"{_ENV}; without it nothing is played")
    one.add_argument("--episodes", type=int, default=20, metavar="N", help="default: 20")
    one.set_defaults(run=actions.report)

    one = commands.add_parser("export", help="write a controller: C code, a function block, ...")
    one.add_argument("law", help=f"{_MODEL}, a law's .npz file, or {_PROBLEM}")
    one.add_argument("path", help="where to write it: .c, .npz, .onnx, .st, .xml (PLCopen) or .fmu")
    one.add_argument("--name", help="prefix of all names in code; default: the file's")
    one.add_argument("--float", action="store_true", help="code in single precision")
    one.add_argument("--absolute", action="store_true", help="readings and inputs as the plant's")
    one.add_argument(
        "--checks", metavar="FILE.json", help="limits of readings, and how to fall back"
    )
    one.add_argument(
        "--observer",
        choices=("none", "caller"),
        default="none",
        help="who estimates what an observer does: an export holds none",
    )
    one.set_defaults(run=actions.export)

    one = commands.add_parser("commission", help="improve a model on its plant, batch by batch")
    one.add_argument("model", help=_MODEL)
    one.add_argument("--env", required=True, help=_ENV)
    one.add_argument("--record", required=True, metavar="FOLDER", help="goes on where it ended")
    one.add_argument("--batches", type=int, default=3, metavar="N", help="in all; default: 3")
    one.add_argument("--batch", type=int, default=4, metavar="N", help="episodes of the first one")
    one.add_argument("--max-correction", type=float, default=0.1, metavar="SHARE")
    one.add_argument("--shadow", action="store_true", help="the MPC acts; the policy only computes")
    one.add_argument("--save", metavar="MODEL.zip", help="where to write the accepted model")
    one.set_defaults(run=actions.commission)
