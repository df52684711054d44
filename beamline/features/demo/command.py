"""`beamline demo`: a simulated scan, from the trigger to the volume and its report, in about a minute."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from beamline.cli.options import POSITIVE, json_events, json_option
from beamline.cli.terminal import Terminal, results
from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Event, RunDone, Sink
from beamline.core.recon_events import VolumeDone
from beamline.core.sinks import fan_out
from beamline.core.stop import StopRequest, stop_signals
from drivers.base.clock import Clock, SystemClock

if TYPE_CHECKING:
    from beamline.config.load import Config
    from recon.base.volume import Grid, Volume


@click.command()
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder in which the new folder for the results is created. Default: storage.folder of configs/demo.yaml "
    "(./runs).",
)
@click.option(
    "--seconds",
    type=POSITIVE,
    help=(
        "Time limit for the reconstruction after the scan, in seconds. If this limit ends the fit early, the volume "
        "is less accurate. Default: as long as the fit needs."
    ),
)
@json_option
def demo(output: Path | None, seconds: float | None, as_json: bool) -> None:
    """Scan and reconstruct a simulated battery, to see what this program does. Takes about a minute.

    \b
    beamline demo

    The battery is reconstructed during the scan. Afterwards the volume and an FBP volume are compared with the ground
    truth, and a report (HTML) is written. The results are in a new folder, named with UTC time and sample. The
    configuration is configs/demo.yaml.
    """
    from beamline.config.load import config_folder, load

    overrides = () if seconds is None else (f"recon.seconds={seconds}",)
    with json_events(as_json) as json_sink:
        config = load(config_folder() / "demo.yaml", overrides)
        stop = StopRequest()
        last: list[Event] = []
        with stop_signals(stop), Terminal(sys.stderr) as terminal:
            run_demo(config, output, [terminal, last.append, json_sink], stop, shlex.join(["beamline", *sys.argv[1:]]))
    if not as_json:
        done = last[-1]
        assert isinstance(done, VolumeDone)
        click.echo(f"{'folder':<10}{done.record.output.parent}\n{results(done.record)}")


def run_demo(config: Config, runs: Path | None, sinks: Sequence[Sink], stop: StopRequest, command: str) -> None:
    """Scan with a live reconstruction, then compare its volume and FBP of the same projections with the ground truth.

    The event `done` is the last one.

    Args:
        config: configuration with simulated devices. runs: folder in which the folder of this run is created; None: the
            configured folder. sinks: event sinks in addition to those of the run. stop: request to stop the scan early.
        command: the command line, which the report shows.

    Raises:
        ConfigError: the configuration names real devices; only a simulator knows the ground truth.
        DataError: the live reconstruction failed; the scan is in its file.
    """
    from beamline.core.files import RECON, RECON_LOG
    from beamline.instrument.connect import connect
    from beamline.scan.live_process import follow_command
    from beamline.scan.run import run_scan

    clock = SystemClock()
    started = clock.now()
    outside = fan_out(*sinks)

    follow = follow_command(config)

    def without_report(scan: Path, output: Path) -> Sequence[str]:
        return [*follow(scan, output), "--no-report"]  # off, because the demonstration writes its own report

    def all_but_done(event: Event) -> None:
        if not isinstance(event, RunDone):  # the scan is done, but the demonstration continues
            outside(event)

    with connect(config) as instrument:
        if instrument.truth is None:
            raise ConfigError(
                "The demonstration needs simulated devices, because only a simulator knows the ground truth."
            )
        truth = instrument.truth
        result = run_scan(config, runs, [all_but_done], stop, live=without_report, instrument=instrument)
    folder = result.path.parent
    if result.recon is None:
        log_file = folder / RECON_LOG
        raise DataError(
            f"The live reconstruction made no volume; the reason is in {log_file}. The scan is not affected."
        )
    shown = _Shown(command, config.recon.seed, config.recon.method, started)
    _compare(result.path, folder / RECON, truth, shown, outside, clock)


@dataclass(frozen=True)
class _Shown:
    """Further facts for the report of the demonstration."""

    command: str
    seed: int
    method: str
    started: float


def _compare(
    scan: Path, volume: Path, truth: Callable[[Grid], Volume], shown: _Shown, sink: Sink, clock: Clock
) -> None:
    """Compare the live volume, and FBP of the same projections, with the ground truth, in a new report."""
    from beamline.gaussians import read_model
    from beamline.projections.prepare import prepare_projections
    from beamline.projections.selection import Selection
    from beamline.projections.views import select
    from beamline.reconstruct.options import OutputPaths, report_beside
    from beamline.reconstruct.record import axis_of, write_result
    from beamline.reconstruct.scan_facts import MadeVolume, ReportContext, facts_of
    from beamline.report.history import history_from
    from beamline.storage.readers.open import open_scan
    from beamline.storage.writers.recon_file import read_reconstruction
    from recon.base.method import Reconstruction
    from recon.base.volume import Grid, Volume

    record = read_reconstruction(volume)
    warnings: list[str] = []
    with open_scan(scan) as source:
        facts = facts_of(source)
        selection = Selection(axis_col=float(str(record.parameters["axis_col"])))
        prepared = prepare_projections(select(source, selection), warnings.append)
        prepared = prepared.stating(axis=axis_of(record.parameters))
    grid = Grid.matching(prepared.geometry)
    ideal = truth(grid)
    reconstruction = Reconstruction(
        volume=Volume(record.volume.data, grid),
        method=shown.method,
        seconds=record.metrics["seconds"],
        history=history_from(record.history),
        settings=record.parameters,
        gaussians=read_model(volume).gaussians if record.model else None,
    )
    target = OutputPaths(volume, report_beside(volume), replace=True)
    if target.live_picture.exists():
        facts = replace(facts, live_picture=target.live_picture.name)
    context = ReportContext(facts, selection, shown.command, shown.seed, warnings, shown.started)
    write_result(MadeVolume(reconstruction, prepared, ideal, target, context), sink, clock)
