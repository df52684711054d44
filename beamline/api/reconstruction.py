"""Reconstruction of a scan file: a volume and its figures, as values; with an output, the files of `beamline recon`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from beamline.api.instrument import Say, to_stderr
from beamline.core.errors import ConfigError
from beamline.core.events import Event, VolumeDone
from beamline.core.narration import sentence
from beamline.core.stop import StopOnSignal
from beamline.projections.selection import Selection
from beamline.reconstruct.offline import reconstruct_file
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.output_paths import OutputPaths, report_beside
from beamline.storage.interrupted import scan_file
from beamline.storage.readers.open import SourceOptions
from beamline.storage.recon_record import ReconRecord
from drivers.base.clock import SystemClock
from recon.auto import Auto
from recon.base.choices import AUTO
from recon.base.method import Method
from recon.base.volume import Volume
from recon.methods import by_name

ReconResult = ReconRecord  # what scripts get


def reconstruct(
    path: str | Path,
    method: str | Method = AUTO,
    *,
    rows: slice | tuple[int, int] | None = None,
    views: str | None = None,
    binning: int | None = None,
    selection: Selection | None = None,
    output: str | Path | None = None,
    say: Say | None = to_stderr,
) -> ReconResult:
    """Reconstruct a finished scan of any format, as `beamline recon` does.

    The first Ctrl-C during a fit or iterations ends with the volume so far (`ended_early`), the second discards it.

    Args:
        path: a scan file, or the folder of a run.
        method: "auto", a name (`recon.methods.names()`), or a method with settings, such as `recon.R2(seconds=30)`.
            `recon.TimeSeries(volumes=4)` makes four volumes in time, which are in `series`.
        rows: detector rows to use, such as slice(500, 756); the volume has one slice a row.
        views: all, fixed:90, first:60, every:2, ... as the option --views takes them.
        binning: pixels that are averaged, a side.
        selection: other options, such as Selection(axis_col=1023.5, steps=(Rings("vo"),)) with a step of
        `beamline.projections.corrections`; the arguments above take precedence.
        output: file of the volume, as -o takes it (.h5, .tif, .npy, ...), with a report beside; None: no file is left.
            A scan that does not fit into the memory needs one.
        say: gets a sentence on what happens; None: nobody does.

    Raises:
        ConfigError: an impossible method or selection. DataError: no scan, data that give no volume, or an output
        that exists or cannot be written. Nothing is written then.
    """
    place, chosen = scan_file(path), _method(method)
    made: list[ReconRecord] = []
    held: list[Volume] = []

    def sink(event: Event) -> None:
        if isinstance(event, VolumeDone):
            made.append(event.record)
        elif say is not None and (text := sentence(event)):
            say(text)

    def take(record: ReconRecord) -> None:
        if output is None:
            held.append(replace(record.volume, data=np.array(record.volume.data)))  # it may lie in a temporary file

    source = SourceOptions(place)
    wanted = selection_of(source, selection, rows=rows, views=views, binning=binning)
    with target_of(output, take) as target:
        command = f"beamline.api.reconstruct({str(place)!r}, {method!r}, rows={wanted.rows}, views={wanted.views!r})"
        options = ReconOptions(source, target, wanted, chosen, command=command)
        reconstruct_file(options, sink, SystemClock(), StopOnSignal())
    (record,) = made
    return record if output is not None else replace(record, volume=held[0], output=None)


def _method(method: str | Method) -> Method:
    if not isinstance(method, str):
        return method
    try:
        return Auto() if method == AUTO else by_name(method)()
    except ValueError as error:
        raise ConfigError(f"{error}. Nothing was written.") from error


def selection_of(
    source: SourceOptions,
    selection: Selection | None,
    *,
    rows: slice | tuple[int, int] | None,
    views: str | None,
    binning: int | None,
) -> Selection:
    """The selection with what is said beside it."""
    stated: dict[str, Any] = {"views": views, "binning": binning, "rows": None if rows is None else _rows(source, rows)}
    return replace(selection or Selection(), **{name: value for name, value in stated.items() if value is not None})


@contextmanager
def target_of(output: str | Path | None, take: Callable[[ReconRecord], None]) -> Iterator[OutputPaths]:
    """Where a result goes, with its report; without an output `take` alone gets it."""
    if output is not None:
        yield OutputPaths(Path(output), report_beside(Path(output)), take=take)
        return
    with tempfile.TemporaryDirectory(prefix="beamline-") as work:
        yield OutputPaths(Path(work) / "volume.h5", None, written=False, take=take)


def _rows(source: SourceOptions, rows: slice | tuple[int, int]) -> tuple[int, int]:
    if not isinstance(rows, slice):
        return rows
    with source.open() as opened:
        first, end, step = rows.indices(opened.shape[0])
    if step != 1:
        raise ConfigError(f"rows {rows}: rows are taken one after the other; leave the step out. Nothing was written.")
    return first, end
