"""Writes the labels of anomalies in a simulated scan as JSON, to test monitors. Also reads the volumes that a scene
names.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beamline.core.events import json_of
from beamline.core.files import write_whole
from beamline.core.flag import PixelBox
from beamline.storage.volumes.files import whole_volume

if TYPE_CHECKING:
    from simulators.effects.chain import AnomalyLabel
    from simulators.samples.sample import ReadVolume


@dataclass(frozen=True)
class LabelledRun:
    """One anomaly in consecutive frames."""

    kind: str  # name of the anomaly
    first: int  # number of the first frame with the anomaly, counted in the file from 0
    # one region for each frame: (first row, row after the last, first column, column after the last)
    regions: tuple[PixelBox, ...]

    @property
    def last(self) -> int:
        return self.first + len(self.regions) - 1


@dataclass
class LabelLog:
    """Collects the labels of consecutive frames."""

    _frames: list[tuple[int, AnomalyLabel]] = field(default_factory=list)

    def add(self, frame: int, labels: Sequence[AnomalyLabel]) -> None:
        self._frames.extend((frame, label) for label in labels)

    def runs(self, n_frames: float = math.inf) -> tuple[LabelledRun, ...]:
        """The labels in the order of their first frames. Only the first `n_frames` frames count."""
        open_runs: dict[tuple[str, int], LabelledRun] = {}
        done: list[LabelledRun] = []
        for frame, label in (entry for entry in self._frames if entry[0] < n_frames):
            body = label.kind, label.which
            run = open_runs.get(body)
            if run is not None and run.last == frame - 1:
                open_runs[body] = LabelledRun(run.kind, run.first, (*run.regions, label.region))
                continue
            done += [run] if run is not None else []
            open_runs[body] = LabelledRun(label.kind, frame, (label.region,))
        return tuple(sorted([*done, *open_runs.values()], key=lambda run: (run.first, run.kind)))


def labels_path(scan: Path) -> Path:
    """Path of the labels of a scan file."""
    return scan.with_suffix(".labels.json")


def write_labels(path: Path, runs: Sequence[LabelledRun], n_frames: int) -> None:
    """Write the labels. A scan without anomalies gets an empty list. The file is written completely or not at all.

    Raises:
        DataError: `path` exists or cannot be written.
    """
    content: dict[str, Any] = {
        "frames": n_frames,
        "region": "first row, row after the last, first column, column after the last",
        "anomalies": [
            {"kind": run.kind, "first_frame": run.first, "last_frame": run.last, "regions": list(run.regions)}
            for run in runs
        ],
    }
    write_whole(path, json_of(content) + "\n")


def volumes_beside(folder: Path) -> ReadVolume:
    """A function that reads the volumes that a scene names, by paths that are absolute or relative to `folder`. It
    raises DataError.
    """
    from simulators.samples.sample import Stored

    return lambda file, dataset: Stored(*whole_volume(folder / file, dataset))  # an absolute path is not changed
