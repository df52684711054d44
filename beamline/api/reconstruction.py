"""Functions that read, follow, check and reconstruct a scan file from Python. They return volumes, numbers and
findings."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from beamline.api.instrument import Say
from beamline.config.load import load, override_of
from beamline.config.monitor import configured_checks, reference_limits
from beamline.core.errors import ConfigError, DataError, refuse_wrong_arguments
from beamline.core.events import Event
from beamline.core.files import JOINED, SCAN, parts_of
from beamline.core.recon_events import VolumeDone
from beamline.core.sinks import sentence
from beamline.core.stop import StopOnSignal, to_stderr
from beamline.monitor.checks import CHECKS
from beamline.page.run_files import watched
from beamline.page.volume import newest
from beamline.projections.replay import ScanVerdict, replay, verdict
from beamline.projections.replayed_frames import awaited, frames_of
from beamline.projections.selection import Selection
from beamline.reconstruct.options import OutputPaths, ReconOptions, report_beside
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.scan.runs import describe
from beamline.storage.interrupted import scan_file
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.recon_record import ReconRecord
from beamline.storage.volumes.files import opened_volume
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame
from recon.auto import method_named
from recon.base.choices import AUTO
from recon.base.method import Method
from recon.base.volume import Volume

ReconResult = ReconRecord  # names that scripts import from here


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

    The first Ctrl-C during a fit or during iterations ends the work with the volume reached so far (`ended_early`). The
    second Ctrl-C discards the volume.

    Args:
        path: a scan file, or the folder of a run.
        method: "auto", a name (`recon.methods.names()`), or a method with settings, such as `recon.R2(seconds=30)`.
            `recon.TimeSeries(volumes=4)` reconstructs four volumes at successive times, which are in `series` of the
            result.
        rows: detector rows to use, such as slice(500, 756); the volume has one slice per row.
        views: projections to use: all, fixed:90, first:60, every:2, ... as for the option --views.
        binning: number of pixels averaged along each side.
        selection: further options, such as Selection(axis_col=1023.5, steps=(Rings("vo"),));
            `beamline.projections.corrections` defines the steps. `rows`, `views` and `binning`, if given, replace
            the values in the selection.
        output: file for the volume, as for the option -o (.h5, .tif, .npy, ...). The report is written next to the
            volume. If `output` is None, no file is written. If the scan does not fit into the memory, an output file is
            required.
        say: function that gets each message that the command would print; None: no messages.

    Raises:
        ConfigError: the method or the selection is not possible.
        DataError: the path is not a scan, no volume can be made from its data, or the output exists or cannot be
            written.

    If an error is raised, no file has been written.
    """
    refuse_wrong_arguments(reconstruct, locals())
    source, chosen = SourceOptions(scan_file(path), frames_per_view=None), _method(method)

    def sink(event: Event) -> None:
        if say is not None and not isinstance(event, VolumeDone) and (text := sentence(event)):
            say(text)

    stated: dict[str, Any] = {"views": views, "binning": binning, "rows": None if rows is None else _rows(source, rows)}
    wanted = replace(selection or Selection(), **{name: value for name, value in stated.items() if value is not None})
    with target_of(output) as target:
        command = (
            f"beamline.api.reconstruct({str(source.path)!r}, {method!r}, rows={wanted.rows}, views={wanted.views!r})"
        )
        options = ReconOptions(source, target, wanted, chosen, command=command)
        record = reconstruct_file(options, sink, SystemClock(), StopOnSignal())
    return record if output is not None else replace(record, output=None)


def _method(method: str | Method) -> Method:
    if not isinstance(method, str):
        return method
    try:
        return method_named(method)
    except ValueError as error:
        raise ConfigError(f"{error}. Nothing was written.") from error


@contextmanager
def target_of(output: str | Path | None) -> Iterator[OutputPaths]:
    """Paths of the result and of its report. Without an output, no file is written."""
    if output is not None:
        yield OutputPaths(Path(output), report_beside(Path(output)))
    else:
        with tempfile.TemporaryDirectory(prefix="beamline-") as work:
            yield OutputPaths(Path(work) / "volume.h5", None, written=False)


def _rows(source: SourceOptions, rows: slice | tuple[int, int]) -> tuple[int, int]:
    if not isinstance(rows, slice):
        return rows
    with source.open() as opened:
        first, end, step = rows.indices(opened.shape[0])
    if step != 1:
        raise ConfigError(
            f"rows {rows}: the detector rows must be consecutive; give a slice without a step. Nothing was written."
        )
    return first, end


_POLL = 0.25  # real s


def monitor(
    path: str | Path, *, config: str | Path | None = None, set: Mapping[str, object] | None = None, follow: bool = False
) -> ScanVerdict:
    """Check every frame of a scan of any format with the monitor, and return the findings that `beamline monitor`
    prints.

    Args:
        path: a scan file, or the folder of a run.
        config: configuration file whose sections `monitor` and `references` give the limits; None: the default limits.
        set: values that replace values of `config`.
        follow: wait for the end of a scan that is still running.

    Raises:
        ConfigError: `config` is wrong.
        DataError: the path is not a scan, or the process of the scan was killed.
    """
    refuse_wrong_arguments(monitor, locals())
    checks, limits = CHECKS, None
    if config is not None:
        read = load(config, [override_of(key, value) for key, value in (set or {}).items()])
        checks, limits = configured_checks(read.monitor), reference_limits(read.references)
    place = scan_file(path)
    with awaited(lambda: open_scan(place, follow=follow), place, SystemClock()) as source:
        return verdict(source, list(replay(source, checks, follow=SystemClock() if follow else None)), limits)


def stream(path: str | Path, *, follow: bool = True) -> Iterator[Frame]:
    """Iterate over the frames of a scan as they are stored, each with its kind, angle and time. If the scan is still
    running, the iteration waits for new frames until the scan ends.

    Frames are counts: `frame.counts` uint16 [row, col].

    If the scan is fast, call `stream` in another process than the scan. Within one process, reading and writing the
    scan file wait for each other, so that a slow reader slows the scan down.

    Args:
        path: a scan file, or the folder of a run. Of a resumed run, only the newest part is read. The scan file need
            not exist yet: the function waits at most 120 s for it.
        follow: False: only the frames that are already in the file.

    Raises:
        DataError: the path is not a scan, no scan begins within 120 s, or the process of the scan was killed.
    """
    refuse_wrong_arguments(stream, locals())
    path = Path(path)
    place = parts_of(path)[-1] / SCAN if path.is_dir() and not (path / JOINED).is_file() else scan_file(path)
    with awaited(lambda: open_scan(place, follow=follow), place, SystemClock()) as source:
        for frame, _ in frames_of(source, follow=SystemClock() if follow else None):
            yield frame


def volumes(run: str | Path) -> Iterator[Volume]:
    """Iterate over the volumes of a run: the live volume after each update, and at the end the finished volume. The
    iteration ends when the run ends.

    Args:
        run: folder of the run. If the run has already ended, only the last volume of the run is returned.

    Raises:
        DataError: the path is not the folder of a run.
    """
    refuse_wrong_arguments(volumes, locals())
    folder, shown = Path(run), None
    watch = watched(folder)
    while True:
        over = describe(folder).over  # asked before the volume is read, so that no volume is missed
        newest_volume = newest(watch.volumes)
        if newest_volume is not None and newest_volume != shown:
            with (
                suppress(DataError),
                opened_volume(newest_volume.path) as record,
            ):  # the next volume is just replacing this one
                volume = replace(record.volume, data=np.array(record.volume.data))
                shown = newest_volume
            if shown is newest_volume:
                yield volume
        if over:
            return
        time.sleep(_POLL)
