"""Reconstruction of a scan file: a volume and its figures, as values; with an output, the files of `beamline recon`."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from beamline.api.instrument import Say, to_stderr
from beamline.core.errors import ConfigError, DataError, refuse_wrong_arguments
from beamline.core.events import Event, VolumeDone
from beamline.core.sinks import sentence
from beamline.core.stop import StopOnSignal
from beamline.energies.scans import EnergyScans, read_spectra
from beamline.projections.selection import Selection
from beamline.reconstruct.options import OutputPaths, ReconOptions, report_beside
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.scan.energies import scans_of
from beamline.storage.interrupted import scan_file
from beamline.storage.readers.open import SourceOptions
from beamline.storage.recon_record import ReconRecord
from drivers.base.clock import SystemClock
from recon.auto import Auto
from recon.base.choices import AUTO
from recon.base.method import Method, volume_names_of
from recon.features.joint.methods import EnergySeries
from recon.methods import by_name

ReconResult = ReconRecord  # what scripts get


def energy_scans(paths: Sequence[str | Path], spectra: str | Path, *, registered: bool = False) -> EnergyScans:
    """Scans of one sample at several energies, which `reconstruct` takes in place of one scan.

    Args:
        paths: a scan or a run's folder of each energy; the folder of a series stands for all of its scans.
        spectra: CSV table of what pure materials attenuate, as of `beamline materials`.
        registered: find where the sample stood in each scan, and its magnification; correct them.

    Raises:
        DataError: the table cannot be read, or there is no scan.
    """
    refuse_wrong_arguments(energy_scans, locals())
    scans = scans_of([Path(path) for path in paths], lambda sentence: None)
    if not scans:
        raise DataError("There is no scan among these paths; expected one at each energy.")
    return EnergyScans(tuple(map(SourceOptions, scans)), read_spectra(Path(spectra)), registered)


def reconstruct(
    path: str | Path | EnergyScans,
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
        path: a scan file, or the folder of a run; or scans at several energies, see `energy_scans`.
        method: "auto", a name (`recon.methods.names()`), or a method with settings, such as `recon.R2(seconds=30)`.
            `recon.TimeSeries(volumes=4)` makes four volumes in time, which are in `series`. Of several energies "auto"
            is `recon.EnergySeries` of the materials in the table, whose volumes are there, too.
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
    refuse_wrong_arguments(reconstruct, locals())
    source = path if isinstance(path, EnergyScans) else SourceOptions(scan_file(path), frames_per_view=None)
    chosen = EnergySeries(source.spectra.names) if method == AUTO and path is source else _method(method)

    def sink(event: Event) -> None:
        if say is not None and not isinstance(event, VolumeDone) and (text := sentence(event)):
            say(text)

    wanted = selection_of(source, selection, rows=rows, views=views, binning=binning)
    with target_of(output) as given:
        target = replace(given, names=volume_names_of(chosen))
        place = str(source.path) if path is not source else list(map(str, (each.path for each in source.scans)))
        command = f"beamline.api.reconstruct({place!r}, {method!r}, rows={wanted.rows}, views={wanted.views!r})"
        options = ReconOptions(source, target, wanted, chosen, command=command)
        record = reconstruct_file(options, sink, SystemClock(), StopOnSignal())
    return record if output is not None else replace(record, output=None, outputs={})


def _method(method: str | Method) -> Method:
    if not isinstance(method, str):
        return method
    try:
        return Auto() if method == AUTO else by_name(method)()
    except ValueError as error:
        raise ConfigError(f"{error}. Nothing was written.") from error


def selection_of(
    source: SourceOptions | EnergyScans,
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
def target_of(output: str | Path | None) -> Iterator[OutputPaths]:
    """Where a result goes, with its report; without an output nothing is written."""
    if output is not None:
        yield OutputPaths(Path(output), report_beside(Path(output)))
        return
    with tempfile.TemporaryDirectory(prefix="beamline-") as work:
        yield OutputPaths(Path(work) / "volume.h5", None, written=False)


def _rows(source: SourceOptions | EnergyScans, rows: slice | tuple[int, int]) -> tuple[int, int]:
    if not isinstance(rows, slice):
        return rows
    with source.open() as opened:
        first, end, step = rows.indices(opened.shape[0])
    if step != 1:
        raise ConfigError(f"rows {rows}: rows are taken one after the other; leave the step out. Nothing was written.")
    return first, end
