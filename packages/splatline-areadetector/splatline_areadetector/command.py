"""`beamline ride`: records the scan of another program, from the image of its areaDetector, as a scan file."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click

from beamline.cli.options import json_events, json_option, set_option
from beamline.cli.terminal import PageBeside, Terminal
from beamline.core.errors import AlarmError, BeamlineError
from beamline.core.events import Event, RunStarted
from beamline.core.run_result import RunResult
from beamline.core.stop import StopRequest, stop_signals
from beamline.core.text import count
from beamline.scan.ledger import LedgerError

if TYPE_CHECKING:
    from beamline.core.events import Sink
    from splatline_areadetector.config import RideConfig


def _print_example(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value:
        from splatline_areadetector.config import EXAMPLE

        click.echo(EXAMPLE, nl=False)
        ctx.exit()


@click.command()
@click.argument("file", metavar="CONFIG", type=click.Path(path_type=Path))
@click.option("--example", is_flag=True, is_eager=True, expose_value=False, callback=_print_example,
              help="Print a configuration to edit, then exit.")  # fmt: skip
@set_option
@click.option("--check", "only_check", is_flag=True,
              help="Record nothing; show the settings of the IOC, and whether 2 s of frames are complete.")  # fmt: skip
@click.option(
    "--darks",
    metavar="FILE",
    help="File with darks, if the scan takes no darks: a scan file, HDF5 (FILE::DATASET) or TIFF.",
)
@click.option(
    "--flats",
    metavar="FILE",
    help="File with flats, if the scan takes no flats: a scan file, HDF5 (FILE::DATASET) or TIFF.",
)
@click.option(
    "--reference", metavar="GOOD", type=click.Path(path_type=Path, exists=True),
    help=(
        "Volume of the same sample from an earlier scan with many projections, or the file of the earlier scan. This "
        "volume is the reference of the live volume, as in `beamline scan`. The option replaces recon.reference in "
        "CONFIG."
    ),
)  # fmt: skip
@click.option("--page", is_flag=True, help="Show the runs in the browser; all runs have the same address.")
@click.option("--no-live", is_flag=True, help="Do not reconstruct during the scan.")
@click.option(
    "--repeat",
    is_flag=True,
    help="Record one scan after the other until Ctrl-C, even if frames are missing in some scans.",
)
@click.option("-o", "--output", type=click.Path(path_type=Path, file_okay=False),
              help="Folder for the folders of runs. Default: storage.folder of CONFIG.")  # fmt: skip
@json_option
def ride(
    file: Path,
    overrides: tuple[str, ...],
    only_check: bool,
    darks: str | None,
    flats: str | None,
    reference: Path | None,
    as_json: bool,
    **more: object,
) -> None:
    """Record the next scan of another program: store the frames that an areaDetector sends over PVAccess.

    CONFIG states the sources of frames and angles. tomoscan, bluesky or another program runs the scan. This command
    stores the frames in the folder of a run, checks them with the monitor, and makes a live volume. It writes no
    process variable and does not slow the scan down. The first Ctrl-C closes the file properly.

    Exit codes: 0 the scan is complete, 2 the configuration or the IOC's settings are wrong, 3 no server answers, 4
    stopped, 5 frames are missing (a message lists them, with the cause if it is known), 7 alarms of the monitor.

    Example: beamline ride my.yaml --page
    """
    from beamline.config.load import load_as, override_of
    from splatline_areadetector.config import RideConfig
    from splatline_areadetector.ride import load_given

    if reference is not None:
        overrides = (*overrides, override_of("recon.reference", reference.resolve()))
    config = load_as(RideConfig, file, overrides, printed_by="beamline ride --example")
    if only_check:
        from splatline_areadetector.looks import check

        click.echo("\n".join(check(config)))
        return
    given = load_given(darks, flats)
    results = list[RunResult]()
    try:
        with json_events(as_json) as json_sink:
            _ride(config, given, results, [json_sink], **more)  # type: ignore[arg-type]
    finally:
        if results and not as_json:
            click.echo("\n".join(_lines(result) for result in results))
    if alarmed := sum(result.alarmed_frames for result in results):
        raise AlarmError(
            f"The scan is complete, but {count(alarmed, 'frame')} {'has' if alarmed == 1 else 'have'} an alarm of the "
            "monitor."
        )


def _ride(
    config: RideConfig,
    given: object,
    results: list[RunResult],
    others: list[Sink],
    *,
    page: bool,
    no_live: bool,
    repeat: bool,
    output: Path | None,
) -> None:
    """Record the next scan; with `repeat`, one scan after the other. Complete scans are added to `results`."""
    from beamline.scan.live_process import Standby
    from splatline_areadetector.ridden import Ride
    from splatline_areadetector.ride import NoScanError, opened, ride_scan

    stop, lacking = StopRequest(), list[LedgerError]()
    with ExitStack() as held:
        held.enter_context(stop_signals(stop))
        terminal = held.enter_context(Terminal(sys.stderr))
        sinks: list[Sink] = [terminal, *others]
        runs = output or Path(config.storage.folder)
        if page:  # one address for all scans
            runs.mkdir(parents=True, exist_ok=True)
            tell = held.enter_context(PageBeside(terminal.say)).serve("runs", str(runs), "--page")

            def tell_of(event: Event) -> None:
                if isinstance(event, RunStarted):
                    tell(f"{event.folder}\n".encode())

            sinks.append(tell_of)
        live = None
        if config.recon.live and not no_live:
            live = Standby()
            held.callback(live.close)
        stream, guide, counters = opened(config, held)
        now = Ride(config, stream, guide, counters, given, runs, stop, terminal.say)  # type: ignore[arg-type]
        while True:
            try:
                results.append(ride_scan(now, sinks, live=live))
            except LedgerError as error:
                if not repeat:
                    raise
                lacking.append(error)
                terminal.say(str(error))
            except BeamlineError as error:
                if not (results or lacking):
                    raise
                _raise_worst("" if isinstance(error, NoScanError) else error, len(results), lacking, terminal.say)
                return
            if not repeat:
                return


def _raise_worst(
    ended: BeamlineError | str, n_whole: int, lacking: Sequence[LedgerError], say: Callable[[str], None]
) -> None:
    """Print how many scans were recorded, and raise the worst error.

    Args:
        ended: why the last scan ended; "" if no scan was running.
    """
    n = n_whole + len(lacking)
    recorded = f"{count(n, 'scan')} before this one" if ended else count(n, "scan")
    recorded = f"Recorded: {recorded}; in {len(lacking)} of these scans, frames are missing."
    if lacking:
        raise LedgerError(" ".join(filter(None, (str(ended), recorded, "The last of these:", str(lacking[-1])))), [])
    if isinstance(ended, BeamlineError):
        raise type(ended)(f"{ended} {recorded}") from ended
    say(recorded)


def _lines(result: RunResult) -> str:
    return f"{'file':<10}{result.path}\n{'frames':<10}{result.n_frames}" + (
        f"\n{'volume':<10}{result.recon.get('output')}" if result.recon else ""
    )
