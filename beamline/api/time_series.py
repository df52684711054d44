"""Volumes in time of a scan file whose sample changes: `beamline recon --time N`, as values."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from beamline.api.instrument import Say, to_stderr
from beamline.api.reconstruction import selection_of, target_of
from beamline.core.events import Event, Warned
from beamline.core.narration import sentence
from beamline.core.signals import StopOnSignal
from beamline.projections.selection import Selection
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.time_series import SeriesDone, WantedSeries
from beamline.reconstruct.time_series import reconstruct_series as made_series
from beamline.storage.interrupted import scan_file
from beamline.storage.readers.open import SourceOptions
from beamline.storage.volumes.files import opened_volume
from beamline.storage.writers.recon_file import ReconRecord
from drivers.base.clock import SystemClock
from recon.base.arrays import F32
from recon.base.volume import Grid


@dataclass(frozen=True, eq=False)
class TimeSeriesResult:
    """Volumes in time of a scan file.

    Attributes:
        seconds: [time] of each volume, from the first view on.
        grid: of each volume.
        units: of the volumes, 1/mm, or 1/px if the pixel size is unknown.
        moves: matter moves; False: only its density changes. `chosen` says how that was decided, empty if given.
        residual: what the volumes leave of the views, over the views.
        axis_col: rotation axis in columns of the full detector.
        warnings: sentences.
        ended_early: Ctrl-C ended it with the volumes so far.
        output, report: files; None if not requested.
    """

    seconds: tuple[float, ...]
    grid: Grid
    units: str
    moves: bool
    chosen: str
    residual: float
    axis_col: float
    warnings: tuple[str, ...]
    ended_early: bool
    output: Path | None
    report: Path | None
    _held: F32 | None = field(default=None, repr=False)

    @cached_property
    def volumes(self) -> F32:
        """The attenuation [time, z, y, x]; read from `output`, if requested, on first use."""
        if self._held is not None:
            return self._held
        assert self.output is not None
        found = []
        for at in range(len(self.seconds)):
            with opened_volume(self.output, at=at) as record:
                found.append(np.asarray(record.volume.data[:], np.float32))
        return np.stack(found)


def reconstruct_series(
    path: str | Path,
    volumes: int,
    *,
    moves: bool | None = None,
    rows: slice | tuple[int, int] | None = None,
    binning: int | None = None,
    selection: Selection | None = None,
    output: str | Path | None = None,
    say: Say | None = to_stderr,
) -> TimeSeriesResult:
    """Fit volumes at even times to one finished scan of a sample that changes, as `beamline recon --time` does.

    Ctrl-C in the sweeps of the fit ends with the volumes so far (`ended_early`); before them it interrupts.

    Args:
        path: a scan file, or the folder of a run.
        volumes: how many, 2 or more; each needs twelve views or more.
        moves: matter moves, or only its density changes; None: what views held out prefer.
        rows, binning, selection, say: as of `beamline.api.reconstruct`.
        output: file of the volumes, .h5, with a report beside; None: no file is left.

    Raises:
        ConfigError: too few views or too little memory. DataError: no scan, or an output that exists or cannot be
            written. Nothing is written then.
    """
    place, clock = scan_file(path), SystemClock()
    source = SourceOptions(place)
    wanted = selection_of(source, selection, rows=rows, views=None, binning=binning)
    warned: list[str] = []
    records: list[ReconRecord] = []

    def sink(event: Event) -> None:
        if isinstance(event, Warned):
            warned.append(event.message)
        if say is not None and (text := sentence(event)):
            say(text)

    with target_of(output, records.append) as target:
        command = f"beamline.api.reconstruct_series({str(place)!r}, {volumes}, moves={moves}, rows={wanted.rows})"
        options = ReconOptions(source, target, wanted, command=command)
        done: SeriesDone = made_series(
            options,
            WantedSeries(volumes, moves),
            sink,
            clock,
            lambda stage: lambda n, of: None,
            StopOnSignal(ready=False),
        )
    (record,) = records
    assert record.series is not None
    return TimeSeriesResult(
        seconds=done.seconds,
        grid=record.volume.grid,
        units=record.unit,
        moves=done.moves,
        chosen=done.chosen,
        residual=done.residual,
        axis_col=done.axis_col,
        warnings=tuple(warned),
        ended_early=done.ended_early,
        output=None if output is None else Path(output),
        report=done.report,
        _held=record.series.data if output is None else None,
    )
