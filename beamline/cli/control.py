"""Commands of configurations, runs, the stage and broken scans: `config`, `check`, `pause` ..., `home`, `recover`."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.options import POSITIVE, config_argument, json_events, json_option, set_option
from beamline.core.errors import INTERRUPTED, ConfigError
from beamline.core.events import DeviceRead, Done, Sink
from beamline.core.files import EVENTS, JOINED, SCAN, open_below, parts_of
from beamline.core.stop import terminated_like_interrupted
from beamline.core.text import one_line
from beamline.plan.passes import Choice
from drivers.base.clock import SystemClock
from drivers.base.errors import DeviceError

if TYPE_CHECKING:
    from beamline.config.load import Config
    from beamline.storage.recover import Recovered

CHOICES = tuple(Choice)
_LOOKS = 50  # a tenth of a second apart: the log of events may be written a moment after the state
_EXIT_CODES = "Exit code: 0 the scan has obeyed, 2 no scan runs there or it does not answer, 5 disk error."


def _command(verb: str, help_text: str) -> click.Command:
    """The command of a `beamline.scan.control.Verb`; `help_text` begins its help."""

    @click.command(verb, help=f"{help_text}\n\n{_EXIT_CODES}")
    @click.argument("run", required=False, type=click.Path(path_type=Path))
    def send(run: Path | None) -> None:
        _send(run, verb)

    return send


def _send(run: Path | None, word: str) -> None:
    """Send a verb, or a choice of what is measured next, to a run (None: the only one), and print its state."""
    from beamline.config.models import StorageSection  # here: help does not need it
    from beamline.scan.control import Verb, tell

    runs = Path(StorageSection.model_fields["folder"].default)
    if run is not None and not run.is_dir():
        raise ConfigError(f"there is no folder {run}; {_running_in(runs)}. Nothing was changed.")
    run = run or _only(runs)
    log = parts_of(run)[-1] / EVENTS
    before = log.stat().st_size if log.is_file() else 0
    state = tell(run, Choice(word) if word in CHOICES else Verb(word))
    if word in CHOICES:
        _require_chosen(run, log.parent, word, before)
    click.echo(f"{run}: {state}")


def _decisions(part: Path, since: int) -> list[Mapping[str, Any]]:
    """Choices of the scan of a part, oldest first, from this byte of its log on; none without a log."""
    from beamline.core.event_lines import event_in

    with suppress(OSError), open_below(part, EVENTS) as log:
        log.seek(since)
        return [event_in(line) or {} for line in log if b'"event": "next_chosen"' in line]
    return []


def _require_chosen(run: Path, part: Path, choice: str, before: int) -> None:
    """Raise ConfigError if the scan does not take this choice in its log from byte `before` on: it was not on offer, or
    another one came first.
    """
    for _ in range(_LOOKS):
        newer = _decisions(part, before)
        if choice in [decision.get("choice") for decision in newer]:
            return
        time.sleep(0.1)
    instead = (
        f"it took {newer[-1].get('choice')}: {newer[-1].get('reason')}" if newer else "it has chosen nothing since"
    )
    raise ConfigError(f"the scan in {run} does not take {choice}, which was not on offer or came too late; {instead}.")


@click.command()
@click.argument("words", nargs=-1, required=True, metavar=f"[RUN] {'|'.join(CHOICES)}")
def decide(words: tuple[str, ...]) -> None:
    """Tell the scan in the folder RUN (the running one of ./runs), while it asks, what to measure next.

    With `scan.decide: ask` a scan asks after each pass of views: the next pass of the plan, the angles of the last one
    again, the offset views, views that were flagged, or no further pass.

    Exit code: 0 the scan has obeyed, 2 no scan runs there, it does not ask, or it takes another choice, 5 disk error.
    """
    *run, choice = words
    if len(run) > 1 or choice not in CHOICES:
        raise click.UsageError(f"{' '.join(words)!r}: expected a folder of a run or none, then {' | '.join(CHOICES)}.")
    _send(Path(run[0]) if run else None, choice)


pause = _command(
    "pause",
    "Pause the scan in the folder RUN (the running one of ./runs). The stage stands, the shutter closes, and no view "
    "is lost or taken twice. `beamline resume` goes on.",
)
resume = _command("resume", "Let the paused scan in the folder RUN (the running one of ./runs) go on.")
stop = _command(
    "stop", "Stop the scan in the folder RUN (the running one of ./runs) cleanly, as the first Ctrl-C does."
)
abort = _command(
    "abort", "Abort the scan in the folder RUN (the running one of ./runs) at once, as the second Ctrl-C does."
)


def _running_in(runs: Path) -> str:
    """Which scans run in a folder, without a full stop."""
    from beamline.scan.control import running

    names = [run.name for run in running(runs)]
    if not names:
        return f"no scan is running in {runs}"
    return f"{len(names)} {'scan runs' if len(names) == 1 else 'scans run'} in {runs}: {', '.join(names)}"


def _only(runs: Path) -> Path:
    """The one run in a folder that goes on."""
    from beamline.scan.control import running

    running_scans = running(runs)
    if len(running_scans) == 1:
        return running_scans[0]
    raise ConfigError(f"{_running_in(runs)}. Name the folder of the run. Nothing was changed.")


@click.command()
@config_argument
@click.option("--yes", is_flag=True, help="Skip the question whether the stage may turn.")
@click.option("--timeout", type=POSITIVE, default=300.0, show_default=True, help="Longest time of the search, s.")
@set_option
def home(file: Path, yes: bool, timeout: float, overrides: tuple[str, ...]) -> None:
    """Search the reference position of the stage in CONFIG.

    THE STAGE TURNS, possibly by a full turn and beyond its soft limits. No other device is connected. Ctrl-C stops
    the stage.

    Exit code: 0 done, 3 the stage has no reference or the search failed, 130 not confirmed or interrupted.
    """
    from beamline.config.load import load
    from beamline.instrument.connect import stage_alone

    config = load(file, overrides)
    stage_config = config.devices.stage
    if not yes:
        way = f"The {stage_config.kind} stage at {stage_config.port} will turn to find its reference. May it turn?"
        try:
            free = click.confirm(way, err=True)
        except click.Abort:  # Ctrl-C, or the end of input: there is no operator
            click.echo(err=True)
            free = False
        if not free:
            click.echo(
                "beamline: The search was not confirmed. Nothing has moved. Use --yes to search without a question.",
                err=True,
            )
            click.get_current_context().exit(INTERRUPTED)
    with terminated_like_interrupted(), stage_alone(config) as stage:
        try:
            stage.start_home()
            angle = stage.wait(timeout)
        except BaseException:
            # Also after a search that failed: the state of the controller is not known. The first error is reported.
            with suppress(DeviceError):
                stage.stop()
            raise
        click.echo(f"The stage has found its reference and is at {math.degrees(angle):.4f} deg.")


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@json_option
def recover(file: Path, as_json: bool) -> None:
    """Turn FILE, whose writer died, into an ordinary scan file; of the folder of a run, all its files.

    Every frame that was committed is kept; a frame that was being written is cut off. The file then opens in any
    program, has its /exchange view and the status `failed`. A file that is in order is left as it is. The frames
    are copied, which takes time and room; whatever stops it leaves FILE as it was.
    """
    from beamline.scan.resume import recover_run
    from beamline.storage.recover import recover as recover_scan

    def say(what: str) -> None:
        click.echo(what, err=True)

    with terminated_like_interrupted(), json_events(as_json) as sink:
        run = file.parent if file.name == JOINED and (file.parent / SCAN).is_file() else file
        recovered, left_out = recover_run(run, say) if run.is_dir() else ([recover_scan(file, say)], [])
        recovered_files(recovered, left_out, sink, as_json)


def recovered_files(recovered: Iterable[Recovered], left_out: Iterable[str], sink: Sink, as_json: bool) -> None:
    """Report each recovered file of a run, and the parts that were left out."""
    for sentence in left_out:
        click.echo(f"Warning: {sentence}", err=True)
    for done in recovered:
        sink(Done(done, time=SystemClock().now()))
        if not as_json:
            click.echo(done.in_words())


@click.group()
def config() -> None:
    """Print a configuration template, a complete configuration, or the schema."""


@config.command(short_help="Print a configuration template to edit.")
@click.option("--instrument", is_flag=True, help="A template for a real instrument instead of simulated devices.")
@click.argument("file", metavar="", required=False)
def init(instrument: bool, file: str | None) -> None:
    """Print a complete, commented configuration to edit: beamline config init > my.yaml"""
    if file is not None:
        raise click.UsageError(f"config init prints a configuration and writes no file: beamline config init > {file}")
    from beamline.config.load import config_folder

    name = "instrument.yaml" if instrument else "simulated.yaml"
    click.echo((config_folder() / name).read_text(encoding="utf-8"), nl=False)


@config.command(short_help="Print a configuration with all defaults.")
@config_argument
@set_option
def show(file: Path, overrides: tuple[str, ...]) -> None:
    """Print CONFIG as a scan would use it: with all defaults, --set and BEAMLINE_* variables applied."""
    from beamline.config.load import load, resolved_yaml

    click.echo(resolved_yaml(load(file, overrides)), nl=False)


@config.command("schema", short_help="Print the JSON schema of a configuration.")
def print_schema() -> None:
    """Print the JSON schema of a configuration, for editors that complete and check YAML files."""
    from beamline.config.load import schema

    click.echo(json.dumps(schema(), indent=2, allow_nan=False))


@click.command()
@config_argument
@set_option
@click.option(
    "--rehearse",
    is_flag=True,
    help="Show the configuration with simulated devices, as `beamline scan --rehearse` would run it.",
)
@click.option(
    "--connect",
    is_flag=True,
    help="Also connect each device, and print who it is and how it stands; no other program may use it meanwhile.",
)
@json_option
def check(file: Path, overrides: tuple[str, ...], rehearse: bool, connect: bool, as_json: bool) -> None:
    """Validate CONFIG. Nothing moves.

    Prints the timeline of the scan: speed, taxi, angular step in counts, motion blur and rolling-shutter skew in
    pixels, duration, bytes to write and free disk space.

    Exit code: 0 valid, 2 wrong configuration or violated limit, 3 a device does not answer.
    """
    from beamline.config.load import load
    from beamline.scan.preflight import doubts, dry_run, refuse_violations

    with json_events(as_json) as sink:
        loaded = load(file, overrides, rehearse=rehearse)
        for sentence in doubts(loaded):
            click.echo(f"Warning: {sentence}", err=True)
        worked = dry_run(loaded)
        if not as_json:
            click.echo("\n".join(worked.lines()))
        refuse_violations(worked.timeline)
        if not as_json:
            click.echo(f"\n{file} is valid: no limit is violated.")
        if connect:
            _read_devices(loaded, as_json, sink)
        sink(Done(worked.data(), time=SystemClock().now()))


def _read_devices(config: Config, as_json: bool, sink: Sink) -> None:
    """Print what each device says. Raises DeviceError at the end if one does not answer."""
    from beamline.instrument.states import SHOWN, device_states

    clock, silent = SystemClock(), list[str]()
    with terminated_like_interrupted():
        for state in device_states(config, clock):
            sink(DeviceRead({"name": state.name, "fault": state.fault, **state.values}, time=clock.now()))
            silent += [state.name] if state.fault else []
            if not as_json:
                sentence = state.fault or ", ".join(
                    f"{name} {one_line(str(value))}" for name, value in state.values.items() if name in SHOWN
                )
                click.echo(f"{state.name:<14}{sentence}")
    if silent:
        advice = "Nothing has moved. Each line above says what to do"
        raise DeviceError("devices", f"{' and '.join(silent)} cannot be used", advice=advice)
