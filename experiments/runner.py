"""Many runs side by side: each one is saved when it is done, and never done twice.

A run is one learner with one seed on one plant. Its outcome is one ``.npz`` file, whose name
holds a hash of the run and of the settings it was made with. Started again after an interruption,
`run_all` does what is missing.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

import numpy as np
import torch
from joblib import Parallel, delayed, parallel_config
from numpy.typing import NDArray
from tqdm import tqdm

from sb3_yann._archive import atomic_write


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
        k, e = int(np.searchsorted(self.checkpoints, episodes)) + 1, episodes
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
        self.failures, self.outcomes = failures, outcomes
        texts = (f"{run}\n{text.rstrip()}" for run, text in failures.items())
        super().__init__(f"{len(failures)} run(s) failed.\n\n" + "\n\n".join(texts))


def run_all(
    runs: Iterable[Run],
    execute: Callable[[Run], Outcome],
    folder: str | os.PathLike[str],
    *,
    fingerprint: str = "",
    jobs: int = -1,
    dask: str | None = None,
    progress: bool = True,
) -> dict[Run, Outcome]:
    """Return the outcome of every run, having done those that `folder` does not hold yet.

    Parameters
    ----------
    runs : iterable of Run
        What is to be done.
    execute : callable
        From a run to its outcome; called in other processes, on one thread each.
    folder : path-like
        One file for each run. A file that cannot be read counts as missing.
    fingerprint : str
        Stands for whatever else the outcomes depend on; files with another one are left alone.
    jobs : int
        Processes on this machine, as joblib counts them: -1 is one for each core.
    dask : str, optional
        Address of a dask scheduler, whose workers then do the work.
    progress : bool
        Print a line for each run that is done, and a bar with the time left.

    Raises
    ------
    RunsFailed
        At the end, if some runs failed.
    """
    runs, target = list(dict.fromkeys(runs)), Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    outcomes = load_all(runs, target, fingerprint)
    missing = [run for run in runs if run not in outcomes]
    missing.sort(key=lambda run: -run.episodes)  # the longest first
    if dask is None:
        stream = _on_this_machine(missing, execute, target, fingerprint, jobs)
    else:
        from experiments.cluster import on_cluster

        stream = on_cluster(missing, execute, target, fingerprint, dask)
    failures: dict[Run, str] = {}
    for run, error in _with_progress(stream, missing, len(runs), progress):
        outcome = None if error else load(run, target, fingerprint)
        if outcome is None:
            failures[run] = error or "The file that was just written cannot be read."
        else:
            outcomes[run] = outcome
    ordered = {run: outcomes[run] for run in runs if run in outcomes}
    if failures:
        raise RunsFailed(failures, ordered)
    return ordered


def play(execute: Callable[[Run], Outcome], run: Run) -> Outcome | str:
    """Return the outcome of a run, or the traceback of its failure."""
    torch.set_num_threads(1)  # the networks are too small to share among cores
    try:
        return execute(run)
    except Exception:
        return traceback.format_exc()


def _play_and_save(
    execute: Callable[[Run], Outcome], run: Run, folder: Path, fingerprint: str
) -> tuple[Run, str | None]:
    outcome = play(execute, run)
    if isinstance(outcome, str):
        return run, outcome
    save(outcome, run, folder, fingerprint)
    return run, None


def _on_this_machine(
    runs: Sequence[Run],
    execute: Callable[[Run], Outcome],
    folder: Path,
    fingerprint: str,
    jobs: int,
) -> Iterator[tuple[Run, str | None]]:
    left = dict.fromkeys(runs)
    with parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = Parallel(n_jobs=jobs, return_as="generator_unordered", batch_size=1)
        calls = (delayed(_play_and_save)(execute, run, folder, fingerprint) for run in runs)
        results = parallel(calls) if runs else iter(())
    try:
        for run, error in results:
            del left[run]
            yield run, error
    except BrokenProcessPool:  # one was killed from outside, or for want of memory
        reason = f"Not done, since the processes stopped:\n{traceback.format_exc()}"
        for run in left:
            yield run, None if load(run, folder, fingerprint) else reason


def _with_progress(
    stream: Iterator[tuple[Run, str | None]], missing: Sequence[Run], total: int, show: bool
) -> Iterator[tuple[Run, str | None]]:
    """Pass the results through, with a bar that counts the training episodes."""
    work = sum(max(1, run.episodes) for run in missing)
    if show:
        print(
            f"{total} runs, {total - len(missing)} done before, {len(missing)} to do.", flush=True
        )
    bar = tqdm(total=work, unit="episode", smoothing=0, disable=not show or not missing)
    with bar:
        for run, error in stream:
            bar.update(max(1, run.episodes))
            if show:
                bar.write(f"{'FAILED' if error else 'done'}: {run}", file=sys.stdout)
            yield run, error


def path_of(run: Run, folder: Path, fingerprint: str) -> Path:
    """Return the file of a run: readable, with a hash of all that it depends on."""
    digest = hashlib.sha256(_key(run, fingerprint).encode()).hexdigest()[:12]
    words = re.sub(r"[^\w]+", "-", f"{run.plant} {run.learner}").strip("-").lower()
    return folder / f"{words}-{run.seed}-{run.episodes}-{digest}.npz"


def save(outcome: Outcome, run: Run, folder: Path, fingerprint: str) -> None:
    """Write the file of a run, which is either whole or not there."""
    target = path_of(run, folder, fingerprint)
    arrays = {name: getattr(outcome, name) for name in (*_ARRAYS, "seconds")}
    arrays |= {f"extra:{name}": value for name, value in outcome.extra.items()}
    with atomic_write(target) as part, part.open("wb") as file:
        np.savez_compressed(file, key=_key(run, fingerprint), **arrays)


def load(run: Run, folder: Path, fingerprint: str) -> Outcome | None:
    """Return the outcome of a run, or None where there is no file or not a whole one."""
    try:
        with path_of(run, folder, fingerprint).open("rb") as file:  # np.load would leave it open
            content = np.load(file, allow_pickle=False)
            arrays = {name: content[name] for name in content.files}
        if str(arrays.pop("key")) != _key(run, fingerprint):
            return None
        extra = {name[6:]: arrays.pop(name) for name in [*arrays] if name.startswith("extra:")}
        return Outcome(**arrays, extra=extra)
    except Exception:  # missing, cut short, or broken in any other way
        return None


def load_all(runs: Iterable[Run], folder: Path, fingerprint: str) -> dict[Run, Outcome]:
    """Return the outcomes that `folder` holds already."""
    found = {run: load(run, folder, fingerprint) for run in runs}
    return {run: outcome for run, outcome in found.items() if outcome is not None}


def _key(run: Run, fingerprint: str) -> str:
    return json.dumps({**asdict(run), "fingerprint": fingerprint}, sort_keys=True)
