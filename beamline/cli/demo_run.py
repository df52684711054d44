"""The demonstration: a simulated scan with its live volume, judged against the sample that the simulator knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from beamline.config.load import Config
from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Event, Sink, fan_out
from beamline.core.narration import sentence
from beamline.core.stop import StopRequest
from beamline.instrument.connect import connect
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.reconstruct.recon_report import ReconOutcome, ReportContext, facts_of
from beamline.reconstruct.result import OutputPaths, axis_of, write_result
from beamline.report.record import history_of
from beamline.scan.live_process import follow_command
from beamline.scan.run import run_scan
from beamline.scan.run_folder import RECON, RECON_LOG
from beamline.storage.readers.open import open_scan
from beamline.storage.writers.recon_file import read_reconstruction
from drivers.clock import SystemClock
from recon.assess.metrics import psnr
from recon.base.volume import Grid, Volume

REPORT = "report.html"


def run_demo(config: Config, runs: Path | None, sinks: Sequence[Sink], stop: StopRequest, command: str) -> None:
    """Scan, grow the volume meanwhile, then judge both it and the FBP of the same views. The event `done` is the last.

    Args:
        config: of simulated devices.
        runs: the folder in which the run gets its own; the configured one unless given.
        sinks: besides the run's own.
        stop: to end it early.
        command: that repeats this, for the record.

    Raises:
        ConfigError: for a real instrument, which knows no truth.
        DataError: the live reconstruction made no volume; the scan is in its file.
    """
    clock = SystemClock()
    started = clock.now()
    checkpoints = _Keeper()
    outside = fan_out(*sinks)

    def all_but_done(event: Event) -> None:
        if event.event != "done":  # of the scan; the demonstration goes on
            outside(event)

    with connect(config) as instrument:
        if instrument.truth is None:
            raise ConfigError("The demonstration needs simulated devices: only a simulator knows the truth.")
        truth = instrument.truth
        result = run_scan(
            config, runs, [checkpoints, all_but_done], stop, live=follow_command(config), instrument=instrument
        )
    folder = result.path.parent
    if result.recon is None:
        raise DataError(f"The live reconstruction made no volume; {folder / RECON_LOG} says why. The scan is unhurt.")

    record = read_reconstruction(folder / RECON)
    warnings: list[str] = []
    with open_scan(result.path) as source:
        facts = facts_of(source)
        selection = Selection(axis_col=float(str(record.parameters["axis_col"])))
        prepared = replace(prepare_projections(source, selection, warnings.append), axis=axis_of(record.parameters))
    grid = Grid.matching(prepared.geometry)
    ideal = truth(grid)
    made = ReconOutcome(
        volume=Volume(record.volume.data, grid),
        method=config.recon.method,
        seconds=record.metrics["seconds"],
        history=history_of(record.history),
        settings=record.parameters,
        psnr=[(seconds, psnr(ideal.data, volume.data)) for seconds, volume in checkpoints.snapshots],
    )
    context = ReportContext(facts, selection, command, config.recon.seed, warnings, started, checkpoints.flags)
    target = OutputPaths(folder / RECON, folder / REPORT, replace=True)
    write_result(made, prepared, ideal, target, context, outside, clock)


class _Keeper:
    """A sink that keeps snapshots to judge them later (the scan needs the processor now), and what was flagged."""

    def __init__(self) -> None:
        self.snapshots: list[tuple[float, Volume]] = []
        self.flags: list[str] = []

    def __call__(self, event: Event) -> None:
        if event.event == "snapshot":
            try:
                volume = read_reconstruction(Path(event.data["path"])).volume
            except DataError:
                return  # the run is over and it is gone
            self.snapshots.append((float(event.data["seconds"]), volume))
        elif event.event in ("flag", "warning"):
            text = sentence(event)
            if text and text not in self.flags:
                self.flags.append(text)
