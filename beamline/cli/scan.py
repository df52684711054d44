"""`beamline scan`: runs the scan of a configuration, or prints its plan."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.control import recovered_files
from beamline.cli.options import json_events, json_option, refuse_contradictions, set_by, set_option, with_request
from beamline.cli.recipe import Repeatable, names_given
from beamline.cli.terminal import PageBeside, Terminal
from beamline.core.errors import AlarmError, ConfigError, DataError
from beamline.core.events import Done, Sink
from beamline.core.files import TABLE
from beamline.core.stop import StopRequest, stop_signals
from beamline.core.text import count
from drivers.base.clock import SystemClock
from recon.base.registry import in_folders

if TYPE_CHECKING:
    from beamline.config.load import Config
    from beamline.core.run_result import RunResult
    from beamline.scan.resume import ResumableRun
    from beamline.scan.series import SeriesRun
    from drivers.in_beam import Ask


@dataclass(frozen=True, eq=False)
class ScanRequest:
    """The arguments of `beamline scan`."""

    files: tuple[Path, ...] = set_by(
        click.argument("files", metavar="[CONFIG|TABLE.csv]...", nargs=-1, type=click.Path(path_type=Path))
    )
    dry: bool = set_by(
        "--dry-run",
        is_flag=True,
        help="Print the timeline, limits and free disk space, and stop. No device is used. "
        "With several scans: print for each scan whether it can run, its size, time and dose, and all faults.",
    )
    overrides: tuple[str, ...] = set_by(set_option)
    rehearse: bool = set_by(
        "--rehearse",
        is_flag=True,
        help="Rehearse the scan: run a CONFIG for a real instrument with simulated devices in place of the real ones.",
    )
    page: bool = set_by(
        "--page",
        is_flag=True,
        help="Also show the run in the browser. There you can pause and stop the scan, as `beamline watch "
        "--control` does.",
    )
    no_live: bool = set_by(
        "--no-live", is_flag=True, help="Do not reconstruct the scan, neither while it runs nor afterwards."
    )
    documents: str | None = set_by(
        "--documents",
        metavar="FILE|tcp://HOST:PORT",
        type=click.Path(dir_okay=False),
        help="Write bluesky documents: append them to FILE, one document per line, or send them to the 0MQ "
        "proxy at HOST:PORT. "
        'Needs: pip install "splatline[bluesky]".',
    )
    stop_on_failure: bool = set_by(
        "--stop-on-failure", is_flag=True, help="With several scans: if one fails, do not start the following scans."
    )
    wait: bool = set_by(
        "--wait",
        is_flag=True,
        help="With several scans: wait for Enter before each scan except the first, so that you can change the sample.",
    )
    as_json: bool = set_by(json_option)
    reference: Path | None = set_by(
        "--reference",
        metavar="GOOD",
        type=click.Path(path_type=Path, exists=True),
        help="Volume of the same sample from an earlier, careful scan, or that scan itself. During the scan, the "
        "live picture shows this reference, moved to the present position of the sample, and what has changed. After "
        "the scan, the volume is made with this reference, as with `beamline recon --reference`. The same as "
        "recon.reference in CONFIG.",
    )
    output: Path | None = set_by(
        "-o",
        "--output",
        type=click.Path(path_type=Path, file_okay=False),
        help="Folder in which the folder of the run is created. Default: storage.folder of CONFIG.",
    )
    run: Path | None = set_by(
        "--resume",
        metavar="RUN",
        type=click.Path(path_type=Path, exists=True, file_okay=False),
        excludes={
            "output": "the run already has its folder",
            "reference": "a resumed run keeps the reference volume of its configuration",
            "rehearse": "a rehearsal always starts a new run, and --resume uses the devices stored in RUN",
            "documents": "documents can describe only complete scans",
        },
        help="Continue the run in this folder: take the missing projections, or the missing flats and darks at the "
        "end, with the configuration stored in the folder.",
    )

    @property
    def file(self) -> Path | None:
        """The configuration of a single scan."""
        return self.files[0] if self.files else None

    @property
    def settings(self) -> tuple[str, ...]:
        """The values that replace those of the configuration."""
        from beamline.config.load import override_of

        reference = self.reference
        return (
            self.overrides
            if reference is None
            else (*self.overrides, override_of("recon.reference", reference.resolve()))
        )

    @property
    def unless_live(self) -> Callable[[str], None] | None:
        """The configuration for a run with --no-live, which a resumed run keeps. The function prints what the run does
        not do without a live reconstruction."""
        return partial(click.echo, err=True) if self.no_live else None


@click.command(cls=Repeatable)
@with_request(ScanRequest)
def scan(request: ScanRequest) -> None:
    """Run the scan that CONFIG describes, check every frame, and reconstruct it while the sample rotates.

    \b
    beamline config init > my.yaml     write a configuration to edit
    beamline scan my.yaml --dry-run    print the plan; nothing moves
    beamline scan my.yaml              run the scan
    beamline scan --resume RUN         continue a run that ended early

    Each run gets a new folder, named with UTC time and sample. The first Ctrl-C, SIGTERM, or closing the terminal
    stops the scan cleanly; the second Ctrl-C aborts it. After a stop and after an abort, the scan file is readable.

    If you give several CONFIGs, or a TABLE.csv with one line per scan (docs/commands.md), the scans run one after the
    other. If one scan fails, the next one starts anyway; Ctrl-C ends all scans.

    If CONFIG has `scan.energies` or `scan.states`, the command takes one scan at each energy, or one scan of each state
    of the sample, and puts all these scans in one folder. --resume can also continue a series of energies or states.

    Exit codes are listed in `beamline --help`. 6: darks or flats cannot be used. 7: the scan is complete, but frames
    have an alarm of the monitor, or darks or flats have a fault.
    """
    _refuse_contradictions(request)
    if _are_several_scans(request.files):
        _queue().take_all(request)
    else:
        with json_events(request.as_json) as json_sink, ExitStack() as held:
            _scan_or_series(request, json_sink, held)


def _scan_or_series(request: ScanRequest, json_sink: Sink, held: ExitStack) -> None:
    """Run a scan, or each scan of a series; or continue a run, whose parts may only need to be joined."""
    from beamline.config.load import load
    from beamline.scan.resume import NotJoined, open_for_resume, recover_run

    file, run = request.file, request.run
    config = (
        None if file is None else load(file, request.settings, rehearse=request.rehearse, no_live=request.unless_live)
    )
    of_series = _config_of_series(config, run, request.documents)
    if of_series is not None and not request.dry:
        _show_series(of_series, take_series(of_series, request, [json_sink], StopRequest()), request, json_sink)
        return
    if of_series is not None:
        run, config = None, of_series
    try:
        series = None if run is None else held.enter_context(open_for_resume(run, config))
    except NotJoined:
        if request.dry or run is None:
            raise
        recovered_files(*recover_run(run), json_sink, request.as_json)
        return
    config = series.config if series else config
    assert config is not None
    _one_scan(config, series, request, json_sink, held)


def _one_scan(
    config: Config, series: ResumableRun | None, request: ScanRequest, json_sink: Sink, held: ExitStack
) -> None:
    """Run the scan, or print its plan.

    Raises:
        AlarmError: the scan is complete, but frames, darks or flats have a fault.
    """
    for sentence in series.left_out if series else ():
        click.echo(f"Warning: {sentence}", err=True)
    _ask_about(config, interactive=not (request.dry or request.rehearse or series))
    if request.dry:
        _dry_run(config, request.output, series, json_sink, request.as_json)
        return
    result = run_one(config, series, request, [json_sink], held)
    held.close()  # bluesky documents are sent before the result is printed
    rehearsed = rehearsed_lines(config, result, request) if request.rehearse else []
    if not request.as_json:
        click.echo("\n".join([_results(result), *rehearsed]))
    if faults := faults_of(result):
        raise AlarmError(f"The scan is complete, but {' '.join(faults)} Details are in {result.path.parent}.")


def _ask_about(config: Config, *, interactive: bool) -> None:
    """Warn about unusual values of the configuration, and ask the user at the terminal whether they are intended.

    Raises:
        ConfigError: they are not intended. Nothing has moved.
    """
    from beamline.scan.dry_run import doubts

    sentences = doubts(config)
    for sentence in sentences:
        click.echo(f"Warning: {sentence}", err=True)
    if sentences and interactive and sys.stdin.isatty() and not click.confirm("Start the scan anyway?", err=True):
        raise ConfigError("The scan was not started, because the values were not confirmed. Nothing has moved.")


def rehearsed_lines(config: Config, result: RunResult, request: ScanRequest) -> list[str]:
    """The duration of the rehearsal, and of the scan at the instrument, as lines."""
    from beamline.plan.timeline import hms_text
    from beamline.scan.dry_run import dry_run

    planned = hms_text(dry_run(config, request.output).timeline.duration)
    return [
        f"{'rehearsed':<10}in {hms_text(result.seconds)}. At the instrument the scan takes {planned}, plus the time "
        "for moving shutter and sample"
    ]


def _refuse_contradictions(request: ScanRequest) -> None:
    """Raise UsageError for options that exclude each other."""
    context = click.get_current_context()
    refuse_contradictions(context.command, names_given(context))
    if request.file is None and request.run is None:
        raise click.UsageError("Missing argument 'CONFIG' (or --resume RUN).")
    several = _are_several_scans(request.files)
    for name, is_given, of_several in (
        ("--resume", request.run is not None, False),
        ("--page", request.page, False),
        ("--documents", request.documents is not None, False),
        ("--stop-on-failure", request.stop_on_failure, True),
        ("--wait", request.wait, True),
    ):
        if is_given and of_several is not several:
            raise click.UsageError(f"{name} works only with {'several scans' if of_several else 'a single scan'}.")
    if request.run is not None and request.overrides and request.file is None:
        raise click.UsageError("--resume continues RUN with the configuration stored in it: leave out --set.")


def _are_several_scans(files: Sequence[Path]) -> bool:
    """Whether the arguments are several configurations, or a table of configurations."""
    return len(files) > 1 or any(file.suffix.lower() == TABLE for file in files)


def _queue() -> Any:
    """The module whose `take_all` runs several scans. Raises UsageError if this installation has none."""
    modules = in_folders("beamline.features", "QUEUES")
    if "scan" not in modules:
        raise click.UsageError("This installation cannot run several scans: give one CONFIG. Nothing was started.")
    return import_module(modules["scan"])


@contextmanager
def _shown(request: ScanRequest, others: Sequence[Sink], stop: StopRequest) -> Iterator[tuple[list[Sink], Ask]]:
    """The event sinks of a scan (terminal, page, then `others`), and the function that asks the operator."""
    from beamline.instrument.connect import ask_operator

    with stop_signals(stop), Terminal(sys.stderr) as terminal, PageBeside(terminal.say) as page:
        sinks: list[Sink] = [terminal, *others, *([page] if request.page else [])]
        yield sinks, lambda question: terminal.ask(question, ask_operator)


def run_one(
    config: Config,
    series: ResumableRun | None,
    request: ScanRequest,
    others: Sequence[Sink],
    held: ExitStack,
    stop: StopRequest | None = None,
) -> RunResult:
    """Run the scan, or continue the run `series`, with output to the terminal, to the page and as bluesky documents."""
    from beamline.scan.live_process import Commands, commands_of
    from beamline.scan.run import run_scan

    stop, commands = stop or StopRequest(), commands_of(config, series) if not request.no_live else Commands()
    if commands.remark:
        click.echo(commands.remark, err=True)
    with _shown(request, others, stop) as (sinks, ask):
        if request.documents is not None:
            sinks.append(import_module("beamline.bluesky.documents").sink(config, request.documents, held))
        place = series or request.output
        return run_scan(config, place, sinks, stop, live=commands, ask=ask)


def _config_of_series(config: Config | None, run: Path | None, documents: str | None) -> Config | None:
    """The configuration of a series, given or stored in its folder `run`; None if it is a single scan."""
    from beamline.config.load import load
    from beamline.core.files import CONFIG
    from beamline.scan.resume import require_same_config
    from beamline.scan.series import is_series

    if run is not None and not is_series(run):
        return None
    if run is not None:
        if config is not None:
            require_same_config(run, (run / CONFIG).read_text("utf-8"), config, CONFIG)
        return load(run / CONFIG, environment={})
    if config is None or not config.series:
        return None
    if documents is not None:
        several = "scan.energies" if config.scan.states is None else "scan.states"
        raise click.UsageError(
            "--documents works only with a single scan: leave out --documents, because the configuration has "
            f"{several}."
        )
    return config


def take_series(config: Config, request: ScanRequest, others: Sequence[Sink], stop: StopRequest) -> SeriesRun:
    """Take the scans of a series, or continue it, with output to the terminal and the page."""
    from beamline.scan.live_process import Commands, commands_of
    from beamline.scan.series import run_series

    with _shown(request, others, stop) as (sinks, ask):
        return run_series(
            config, request.output, sinks, stop,
            lambda config, rest: Commands() if request.no_live else commands_of(config, rest),
            series=request.run, ask=ask,
        )  # fmt: skip


def _show_series(config: Config, done: SeriesRun, request: ScanRequest, json_sink: Sink) -> None:
    name, unit = ("energy_kev", "{:.7g} keV") if config.scan.states is None else ("state", "state {}")
    data = {"folder": done.folder, "scans": [{name: value, "path": path} for value, path in done.scans]}
    json_sink(Done(data, time=SystemClock().now()))
    if not request.as_json:
        click.echo("\n".join(f"{unit.format(value):<14}{path}" for value, path in done.scans))
        if config.scan.states is None:
            click.echo(f"{'materials':<14}beamline materials {done.folder} --spectra SPECTRA.csv -o OUT.h5")
    if faults := [fault for result in done.results for fault in faults_of(result)]:
        raise AlarmError(f"The scans are complete, but {' '.join(faults)} Details are in {done.folder}.")


def faults_of(result: RunResult) -> list[str]:
    """The faults of the frames of a complete scan, and their consequences."""
    from beamline.storage.flag_legend import counted

    words = []
    if result.alarmed_frames:
        verb = "has" if result.alarmed_frames == 1 else "have"
        retaken_text = f" (not counting {count(result.retaken, 'projection')} taken again)" if result.retaken else ""
        words.append(
            f"{result.alarmed_frames} of {result.n_frames} frames {verb} an alarm of the monitor{retaken_text}: "
            f"{counted(result.flags)}."
        )
    if result.alarmed_views and (treated := _treated(result.path)):
        words.append(
            f"With --flags use, a reconstruction does this: {treated} Repeat the scan if too many projections are lost."
        )
    return [*words, *result.reference_faults]


def _treated(path: Path) -> str:
    """How a reconstruction will treat flagged projections, as a sentence; "" if the file does not state it."""
    from beamline.storage.readers.open import open_scan
    from beamline.storage.rules.flag_policy import flag_policy

    with suppress(DataError), open_scan(path) as source:
        views = source.table.are_views
        return "" if source.table.flags is None else flag_policy(source.table.flags, views, source.shape).in_words
    return ""


def _dry_run(config: Config, output: Path | None, series: ResumableRun | None, json_sink: Sink, as_json: bool) -> None:
    from beamline.scan.dry_run import dry_run, refuse_violations

    worked = dry_run(config, output) if series is None else dry_run(config, series.run, series.remaining)
    if not as_json:
        click.echo("\n".join(worked.lines()))
    refuse_violations(worked.timeline)
    json_sink(Done(worked.data(), time=SystemClock().now()))


def _results(result: RunResult) -> str:
    from beamline.core.files import RECON
    from beamline.storage.flag_legend import counted

    folder, recon = result.path.parent, result.recon
    rows = {
        "scan": result.path,
        "frames": str(result.n_frames),
        "flagged": result.flags and f"{counted(result.flags)}; see {folder}",
        "retaken": result.retaken and f"{count(result.retaken, 'flagged projection')}; recon uses the new projections",
        "volume": None if recon is None else recon.get("output", folder / RECON),
        "report": None if recon is None else recon.get("report"),
    }
    return "\n".join(f"{name:<10}{text}" for name, text in rows.items() if text)
