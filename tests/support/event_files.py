"""Reads what a run has written for tensorboard."""

from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator


def scalars(folder: Path) -> dict[str, list[float]]:
    """Return the scalars of the only run in a folder, by their tags."""
    (run,) = folder.iterdir()
    events = EventAccumulator(str(run)).Reload()
    return {tag: [e.value for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
