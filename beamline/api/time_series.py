"""Volumes in time of a scan file whose sample changes: `beamline recon --time N`, as values."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from beamline.api.instrument import Say, to_stderr
from beamline.api.reconstruction import selection_of, target_of
from beamline.core.events import Event
from beamline.core.narration import sentence
from beamline.core.signals import StopOnSignal
from beamline.projections.selection import Selection
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.time_series import SeriesRequest, TimeSeriesResult
from beamline.reconstruct.time_series import reconstruct_series as fitted_series
from beamline.storage.interrupted import scan_file
from beamline.storage.readers.open import SourceOptions
from drivers.base.clock import SystemClock


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

    def sink(event: Event) -> None:
        if say is not None and (text := sentence(event)):
            say(text)

    with target_of(output, lambda record: None) as target:
        command = f"beamline.api.reconstruct_series({str(place)!r}, {volumes}, moves={moves}, rows={wanted.rows})"
        options = ReconOptions(source, target, wanted, command=command)
        result = fitted_series(
            options,
            SeriesRequest(volumes, moves),
            sink,
            clock,
            lambda stage: lambda n, of: None,
            StopOnSignal(ready=False),
        )
    return result if output is not None else replace(result, output=None)
