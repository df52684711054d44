"""The commands `config`, `check`, `pause`, `resume`, `stop`, `abort`, `decide`, `home` and `recover`."""

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
# number of attempts, a tenth of a second apart, because the log of events may be written a moment after the state
_LOOKS = 50
_EXIT_CODES = (
    "Exit code: 0 the scan has carried out the command, 2 no scan runs in the folder or the scan does not answer, 5 "
    "disk error."
)


def _command(verb: str, help_text: str) -> click.Command:
    """The command `beamline VERB` for a `beamline.scan.control.Verb`; its help begins with `help_text`."""

    @click.command(verb, help=f"{help_text}\n\n{_EXIT_CODES}")
    @click.argument("run", required=False, type=click.Path(path_type=Path))
    def send(run: Path | None) -> None:
        _send(run, verb)

    return send


def _send(run: Path | None, word: str) -> None:
    """Send a command, or the decision what to measure next, to a run (None: the only one), and print its state."""
    from beamline.config.models import StorageSection  # imported here because help does not need it
    from beamline.scan.control import Verb, tell
    from beamline.storage.run_record import is_series_folder

    runs = Path(StorageSection.model_fields["folder"].default)
    if run is not None and not run.is_dir():
        raise ConfigError(f"the folder {run} does not exist; {_running_in(runs)}. Nothing was changed.")
    run = _only(runs if run is None else run) if run is None or is_series_folder(run) else run
    log = parts_of(run)[-1] / EVENTS
    before = log.stat().st_size if log.is_file() else 0
    state = tell(run, Choice(word) if word in CHOICES else Verb(word))
    if word in CHOICES:
        _require_chosen(run, log.parent, word, before)
    click.echo(f"{run}: {state}")


def _decisions(part: Path, since: int) -> list[Mapping[str, Any]]:
    """Decisions in the log of a part of a run, oldest first, from byte `since` on; empty if there is no log."""
    from beamline.core.event_lines import event_in

    with suppress(OSError), open_below(part, EVENTS) as log:
        log.seek(since)
        return [event_in(line) or {} for line in log if b'"event": "next_chosen"' in line]
    return []


def _require_chosen(run: Path, part: Path, choice: str, before: int) -> None:
    """Raise ConfigError unless the log of the scan, from byte `before` on, shows that the scan takes this choice. If
    not, the choice was not offered, or another choice came first.
    """
    for _ in range(_LOOKS):
        newer = _decisions(part, before)
        if choice in [decision.get("choice") for decision in newer]:
            return
        time.sleep(0.1)
    instead = (
        f"the scan chose {newer[-1].get('choice')} instead: {newer[-1].get('reason')}"
        if newer
        else "the scan has made no other choice"
    )
    raise ConfigError(
        f"the scan in {run} does not measure {choice} next, because the scan did not offer this choice, or because "
        f"your choice came too late; {instead}."
    )


@click.command()
@click.argument("words", nargs=-1, required=True, metavar=f"[RUN] {'|'.join(CHOICES)}")
def decide(words: tuple[str, ...]) -> None:
    """Tell a scan that waits for your decision what to measure next.

    \b
    beamline decide again         measure the angles of the last pass once more
    beamline decide RUN enough    measure no further pass (scan in the folder RUN)

    With `scan.decide: ask` in its configuration, a scan asks after each pass: next (the next pass of the plan), again
    (the angles of the last pass once more), offset (the laterally offset projections), retake (flagged projections and
    those without a frame), or enough (no further pass). Without RUN, the command goes to the only running scan in
    ./runs.

    Exit code: 0 the scan takes your choice, 2 no scan runs in the folder, the scan does not wait for a decision, it
    does not offer your choice, or your choice came too late, 5 disk error.
    """
    *run, choice = words
    if len(run) > 1 or choice not in CHOICES:
        raise click.UsageError(
            f"{' '.join(words)!r}: expected {' | '.join(CHOICES)}. If several scans run, write the folder of the run "
            "before the choice."
        )
    _send(Path(run[0]) if run else None, choice)


pause = _command(
    "pause",
    "Pause a running scan, from another terminal.\n\n\b\nbeamline pause        the only running scan in ./runs\n"
    "beamline pause RUN    the scan in the folder RUN\n\nThe stage stops and the shutter closes. No projection is lost "
    "or taken twice. `beamline resume` continues the scan.",
)
resume = _command(
    "resume",
    "Continue a paused scan, from another terminal.\n\n\b\nbeamline resume        the paused scan in ./runs\n"
    "beamline resume RUN    the scan in the folder RUN",
)
stop = _command(
    "stop",
    "Stop a running scan cleanly, from another terminal, as the first Ctrl-C does.\n\n\b\n"
    "beamline stop        the only running scan in ./runs\nbeamline stop RUN    the scan in the folder RUN\n\n"
    "The scan still stores the frames that are already triggered, takes darks or flats if it has none yet, and returns "
    "the stage. `beamline scan --resume RUN` continues the run later.",
)
abort = _command(
    "abort",
    "Abort a running scan immediately, from another terminal, as the second Ctrl-C does.\n\n\b\nbeamline abort      "
    "  the only running scan in ./runs\nbeamline abort RUN    the scan in the folder RUN\n\nNo further frame is "
    "taken. The scan file is readable, and `beamline scan --resume RUN` can continue the run.",
)


def _running_in(runs: Path) -> str:
    """Which scans are running in a folder, as a sentence without its full stop."""
    from beamline.scan.control import running

    names = [run.name for run in running(runs)]
    if not names:
        return f"no scan is running in {runs}"
    return f"{len(names)} {'scan is' if len(names) == 1 else 'scans are'} running in {runs}: {', '.join(names)}"


def _only(runs: Path) -> Path:
    """The only running scan in a folder."""
    from beamline.scan.control import running

    running_scans = running(runs)
    if len(running_scans) == 1:
        return running_scans[0]
    raise ConfigError(f"{_running_in(runs)}. Name the folder of the run. Nothing was changed.")


@click.command()
@config_argument
@click.option("--yes", is_flag=True, help="Do not ask whether the stage may turn.")
@click.option(
    "--timeout",
    type=POSITIVE,
    default=300.0,
    show_default=True,
    help=("Time limit in seconds for the search of the reference mark."),
)
@set_option
def home(file: Path, yes: bool, timeout: float, overrides: tuple[str, ...]) -> None:
    """Turn the stage in CONFIG to its reference mark, so that its angles are right.

    \b
    beamline home my.yaml

    THE STAGE TURNS, possibly by 360° and beyond its soft limits. The command asks for confirmation first. It connects
    to no other device. Ctrl-C stops the stage.

    Exit code: 0 done, 3 the stage has no reference or the search failed, 130 not confirmed or interrupted.
    """
    from beamline.config.load import load
    from beamline.instrument.connect import stage_alone

    config = load(file, overrides)
    stage_config = config.devices.stage
    if not yes:
        way = f"The {stage_config.kind} stage at {stage_config.port} will turn to find its reference mark. May it turn?"
        try:
            free = click.confirm(way, err=True)
        except click.Abort:  # Ctrl-C, or the end of the input, because there is no operator
            click.echo(err=True)
            free = False
        if not free:
            click.echo(
                "beamline: Nothing has moved, because the search was not confirmed. --yes skips the question.",
                err=True,
            )
            click.get_current_context().exit(INTERRUPTED)
    with terminated_like_interrupted(), stage_alone(config) as stage:
        try:
            stage.start_home()
            angle = stage.wait(timeout)
        except BaseException:
            # Stop also after a failed search, because the state of the controller is unknown. The first error counts.
            with suppress(DeviceError):
                stage.stop()
            raise
        click.echo(f"The stage has found its reference mark and is at {math.degrees(angle):.4f} deg.")


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@json_option
def recover(file: Path, as_json: bool) -> None:
    """Repair the file of a scan whose process was killed, so that any program can read it.

    \b
    beamline recover RUN            repair all files in the folder of a run
    beamline recover RUN/scan.h5    repair one file
    beamline recover SERIES         repair all runs of a series of energies or states

    The command keeps all complete frames, and drops a frame that was being written. The repaired file has the group
    /exchange and the status `failed`. The command does not change an intact file. To repair a file, it copies the
    frames, which takes time and disk space. If the command is interrupted or fails, FILE stays as it was.
    """
    from beamline.scan.resume import recover_run
    from beamline.storage.recover import recover as recover_scan

    def say(what: str) -> None:
        click.echo(what, err=True)

    with terminated_like_interrupted(), json_events(as_json) as sink:
        run = file.parent if file.name == JOINED and (file.parent / SCAN).is_file() else file
        for each in _runs_of(run):
            recovered, left_out = recover_run(each, say) if each.is_dir() else ([recover_scan(each, say)], [])
            recovered_files(recovered, left_out, sink, as_json)


def _runs_of(path: Path) -> list[Path]:
    """The runs of a series that have a scan file; any other path itself."""
    from beamline.storage.run_record import is_series_folder

    runs = sorted(scan.parent for scan in path.glob(f"*/{SCAN}")) if is_series_folder(path) else []
    return runs or [path]


def recovered_files(recovered: Iterable[Recovered], left_out: Iterable[str], sink: Sink, as_json: bool) -> None:
    """Report each repaired file of a run, and the parts that could not be repaired."""
    for sentence in left_out:
        click.echo(f"Warning: {sentence}", err=True)
    for done in recovered:
        sink(Done(done, time=SystemClock().now()))
        if not as_json:
            click.echo(done.in_words())


@click.group()
def config() -> None:
    """Print a configuration to edit, a configuration with all defaults, or the JSON schema.

    \b
    beamline config init > my.yaml                 simulated devices, to edit
    beamline config init --instrument > my.yaml    a real instrument, to edit
    beamline config show my.yaml                   my.yaml with all defaults
    """


@config.command(short_help="Print a configuration to edit.")
@click.option(
    "--instrument",
    is_flag=True,
    help=("Print a configuration for a real instrument. Default: a configuration with simulated devices."),
)
@click.argument("file", metavar="", required=False)
def init(instrument: bool, file: str | None) -> None:
    """Print a complete configuration with comments, to edit.

    \b
    beamline config init > my.yaml
    """
    if file is not None:
        raise click.UsageError(
            f"config init prints the configuration and writes no file. Use: beamline config init > {file}"
        )
    from beamline.config.load import config_folder

    name = "instrument.yaml" if instrument else "simulated.yaml"
    click.echo((config_folder() / name).read_text(encoding="utf-8"), nl=False)


@config.command(short_help="Print a configuration with all defaults.")
@config_argument
@set_option
def show(file: Path, overrides: tuple[str, ...]) -> None:
    """Print CONFIG as a scan would use it: with all defaults, --set and BEAMLINE_* variables applied.

    \b
    beamline config show my.yaml --set scan.period_s=0.2
    """
    from beamline.config.load import load, resolved_yaml

    click.echo(resolved_yaml(load(file, overrides)), nl=False)


@config.command("schema", short_help="Print the JSON schema of a configuration.")
def print_schema() -> None:
    """Print the JSON schema of a configuration, for editors that complete and check YAML files.

    \b
    beamline config schema > schema.json
    """
    from beamline.config.load import schema

    click.echo(json.dumps(schema(), indent=2, allow_nan=False))


@click.command()
@config_argument
@set_option
@click.option(
    "--rehearse",
    is_flag=True,
    help="Check the configuration with simulated devices in place of the real ones, as `beamline scan --rehearse` runs "
    "it.",
)
@click.option(
    "--connect",
    is_flag=True,
    help="Also connect to every device and print its identity and status. Close other programs that use the devices "
    "first.",
)
@json_option
def check(file: Path, overrides: tuple[str, ...], rehearse: bool, connect: bool, as_json: bool) -> None:
    """Check CONFIG for errors, and print the plan of its scan. Nothing moves.

    \b
    beamline check my.yaml
    beamline check my.yaml --connect    also connect to every device

    The plan lists the speed of the stage, its run-up, the angular step in counts of the stage, motion blur and
    rolling-shutter skew in pixels, the duration, the size of the data and the free disk space.

    Exit code: 0 valid, 2 wrong configuration or violated limit, 3 a device does not answer.
    """
    from beamline.config.load import load
    from beamline.scan.dry_run import doubts, dry_run, refuse_violations

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
    """Print identity and status of each device. Raises DeviceError at the end if one does not answer."""
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
        advice = "Nothing has moved. The lines above say what to do for each device"
        raise DeviceError("devices", f"{' and '.join(silent)} cannot be used", advice=advice)
