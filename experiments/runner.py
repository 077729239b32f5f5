"""Many runs side by side. Each is saved in one file of results as it ends, and never done twice.

A run is one learner with one seed on one plant. The file is an SQLite database: a row for each run,
whose arrays are a compressed ``.npz``. Started again after an interruption, `run_all` does what is
missing.
"""

from __future__ import annotations

import io
import sqlite3
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, nullcontext
from dataclasses import astuple, dataclass, field, fields, replace
from pathlib import Path

import numpy as np
import torch
from joblib import Parallel, delayed, parallel_config
from numpy.typing import NDArray
from tqdm import tqdm

RESULTS = Path(__file__).with_name("results.sqlite")
"""All runs that the tables of the documentation show."""
FINGERPRINT = "0.1.0-3"
"""Of the settings that a run depends on; results of others are not taken for those of these."""


@dataclass(frozen=True)
class Run:
    """One learner with one seed on one plant.

    Attributes
    ----------
    plant, learner : str
        Names, as the tables show them.
    seed : int
    episodes : int
        Training episodes; 0 for a controller that does not learn.
    """

    plant: str
    learner: str
    seed: int
    episodes: int

    def __str__(self) -> str:
        return f"{self.plant} / {self.learner} / seed {self.seed} / {self.episodes} episodes"


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of a run, in arrays.

    Attributes
    ----------
    checkpoints : ndarray of int, shape (k,)
        Training episodes after which the policy was tested, rising from 0.
    test_costs : ndarray, shape (k, s)
        Undiscounted cost of each of s test starts.
    test_violations : ndarray of int, shape (k, s)
        Steps beyond the safety limit.
    training_costs : ndarray, shape (e,)
        Cost of each training episode, as it was played.
    training_mpc_costs : ndarray, shape (e,)
        What the MPC costs from the same start.
    training_violations : ndarray of int, shape (e,)
    extra : mapping of str to ndarray
        Anything else worth keeping.
    seconds : float
    """

    checkpoints: NDArray[np.int64]
    test_costs: NDArray[np.float64]
    test_violations: NDArray[np.int64]
    training_costs: NDArray[np.float64]
    training_mpc_costs: NDArray[np.float64]
    training_violations: NDArray[np.int64]
    extra: Mapping[str, NDArray[np.generic]] = field(default_factory=dict)
    seconds: float = 0.0

    def __post_init__(self) -> None:
        for name in _ARRAYS:
            kind = np.int64 if name == "checkpoints" or "violations" in name else np.float64
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=kind))
        extra = {name: np.asarray(value) for name, value in self.extra.items()}
        object.__setattr__(self, "extra", extra)
        object.__setattr__(self, "seconds", float(self.seconds))
        if self.checkpoints.ndim != 1 or not len(self.checkpoints):
            raise ValueError("checkpoints must be a one-dimensional array with an entry.")
        if len(self.test_costs) != len(self.checkpoints) or self.test_costs.ndim != 2:
            raise ValueError("test_costs needs one row for each checkpoint.")
        if self.test_violations.shape != self.test_costs.shape:
            raise ValueError("test_violations and test_costs differ in shape.")
        lengths = {len(getattr(self, name)) for name in _ARRAYS if name.startswith("training")}
        if len(lengths) > 1:
            raise ValueError("The arrays of the training episodes differ in length.")
        if any(value.dtype == object for value in extra.values()):
            raise ValueError("extra holds plain arrays only.")

    def at(self, episodes: int) -> Outcome:
        """Return the same run as it stood after so many training episodes.

        A controller that does not learn stands where it always does. Raises a `ValueError` where
        the run was not tested then. `extra` and `seconds` stay those of the whole run.
        """
        if self.checkpoints[-1] == 0:
            return self
        if episodes not in self.checkpoints:
            raise ValueError(f"The run was not tested after {episodes} training episodes.")
        k = int(np.searchsorted(self.checkpoints, episodes)) + 1
        e = episodes
        tested = {name: getattr(self, name)[:k] for name in _ARRAYS[:3]}
        return replace(self, **tested, **{name: getattr(self, name)[:e] for name in _ARRAYS[3:]})


_ARRAYS = tuple(item.name for item in fields(Outcome) if item.name not in ("extra", "seconds"))


class RunsFailed(RuntimeError):
    """Some runs failed; the others are saved.

    Attributes
    ----------
    failures : dict of Run to str
        The traceback of each.
    outcomes : dict of Run to Outcome
        What did not fail.
    """

    def __init__(self, failures: dict[Run, str], outcomes: dict[Run, Outcome]) -> None:
        self.failures = failures
        self.outcomes = outcomes
        texts = (f"{run}\n{text.rstrip()}" for run, text in failures.items())
        super().__init__(f"{len(failures)} run(s) failed.\n\n" + "\n\n".join(texts))


def run_all(
    runs: Iterable[Run],
    execute: Callable[[Run], Outcome],
    results: Path = RESULTS,
    *,
    jobs: int = -1,
    dask: str | None = None,
    progress: bool = True,
) -> dict[Run, Outcome]:
    """Return the outcome of every run, having done those that the file does not hold yet.

    Parameters
    ----------
    runs : iterable of Run
        What is to be done.
    execute : callable
        From a run to its outcome; called in other processes, on one thread each.
    results : Path
        The file; made where it is missing.
    jobs : int
        Processes on this machine, as joblib counts them: -1 is one for each core.
    dask : str, optional
        Address of a dask scheduler, whose workers then do the work. They need this repository and
        ``--nthreads 1``, since Stable-Baselines3 seeds the generators of a whole process.
    progress : bool
        Print a line for each run that is done, and a bar with the time left.

    Raises
    ------
    RunsFailed
        At the end, if some runs failed.
    """
    runs = list(dict.fromkeys(runs))
    results.parent.mkdir(parents=True, exist_ok=True)
    outcomes = load_all(runs, results)
    missing = [run for run in runs if run not in outcomes]
    missing.sort(key=lambda run: -run.episodes)  # the longest first
    failures: dict[Run, str] = {}
    bar = tqdm(
        total=sum(max(1, run.episodes) for run in missing),
        unit="episode",
        smoothing=0,
        disable=not progress,
    )
    with bar:
        for run, outcome in _played(missing, execute, jobs, dask):
            if isinstance(outcome, Outcome):
                save(outcome, run, results)
                outcomes[run] = outcome
            else:
                failures[run] = outcome
            bar.update(max(1, run.episodes))
            if progress:
                bar.write(f"{'FAILED' if run in failures else 'done'}: {run}", file=sys.stdout)
    ordered = {run: outcomes[run] for run in runs if run in outcomes}
    if failures:
        raise RunsFailed(failures, ordered)
    return ordered


def _played(
    runs: list[Run], execute: Callable[[Run], Outcome], jobs: int, dask: str | None
) -> Iterator[tuple[Run, Outcome | str]]:
    if not runs:
        return
    backend = "loky"
    client = nullcontext()
    options = {"inner_max_num_threads": 1}
    if dask is not None:
        from distributed import Client

        backend = "dask"
        client = Client(dask)
        options = {}
    with client, parallel_config(backend=backend, **options):
        parallel = Parallel(n_jobs=jobs, return_as="generator_unordered", batch_size=1)
        yield from parallel(delayed(_play)(execute, run) for run in runs)


def _play(execute: Callable[[Run], Outcome], run: Run) -> tuple[Run, Outcome | str]:
    """Return a run with its outcome, or with the traceback of its failure."""
    torch.set_num_threads(1)  # the networks are too small to share among cores
    try:
        return run, execute(run)
    except Exception:
        return run, traceback.format_exc()


def _opened(results: Path) -> sqlite3.Connection:
    database = sqlite3.connect(results, timeout=60)
    database.execute(
        "CREATE TABLE IF NOT EXISTS runs (plant, learner, seed, episodes, fingerprint, arrays, "
        "PRIMARY KEY (plant, learner, seed, episodes, fingerprint))"
    )
    return database


def save(outcome: Outcome, run: Run, results: Path = RESULTS) -> None:
    """Write the row of a run, whole or not at all."""
    arrays = {name: getattr(outcome, name) for name in (*_ARRAYS, "seconds")}
    arrays |= {f"extra:{name}": value for name, value in outcome.extra.items()}
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    row = (*astuple(run), FINGERPRINT, file.getvalue())
    with closing(_opened(results)) as database, database:
        database.execute("INSERT OR REPLACE INTO runs VALUES (?, ?, ?, ?, ?, ?)", row)


def load_all(runs: Iterable[Run], results: Path = RESULTS) -> dict[Run, Outcome]:
    """Return the outcomes that the file holds already."""
    if not results.exists():
        return {}
    with closing(_opened(results)) as database:
        rows = database.execute(
            "SELECT plant, learner, seed, episodes, arrays FROM runs WHERE fingerprint = ?",
            (FINGERPRINT,),
        ).fetchall()
    found: dict[Run, Outcome] = {}
    wanted = set(runs)
    for *key, content in rows:
        if Run(*key) in wanted:
            arrays = dict(np.load(io.BytesIO(content), allow_pickle=False))
            extra = {name[6:]: arrays.pop(name) for name in [*arrays] if name.startswith("extra:")}
            found[Run(*key)] = Outcome(**arrays, extra=extra)
    return {run: found[run] for run in runs if run in found}
