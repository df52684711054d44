"""`beamline scan` with several configurations, or with a table of them."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any

import click

from beamline.cli.options import json_events
from beamline.cli.scan import TABLE, ScanRequest, faults_of, rehearsed_lines, run_one, take_energies
from beamline.config.load import Config, load
from beamline.core.errors import AlarmError, BeamlineError, ConfigError, ScanStopped, exit_code, user_message
from beamline.core.events import Done, Event, RunStarted, Sink, StateEntered
from beamline.core.files import SETTINGS, text_in
from beamline.core.stop import StopRequest
from beamline.core.text import aligned, count, size
from beamline.instrument.connect import ask_operator
from beamline.plan.limits import ROOM
from beamline.plan.timeline import hms_text
from beamline.scan.moves import UNSAFE
from beamline.scan.preflight import DryRun, dry_run
from drivers.base.clock import SystemClock

_CONFIG = "config"  # the column with the configuration's file


class QueueStatus(StrEnum):
    """How a scan of a queue ended."""

    COMPLETE = "complete"
    ALARMS = "alarms"
    FAILED = "failed"
    STOPPED = "stopped"
    NOT_STARTED = "not started"


Taken = tuple[Path, Sequence[str]]
"""A finished scan, or series of energies: its path, and the faults of its frames, a sentence each."""


@dataclass(frozen=True)
class ScanOutcome:
    """How a scan of a queue ended, where its files are, and why it is incomplete."""

    name: str
    status: QueueStatus
    path: Path | None = None
    why: str = ""
    exit_code: int = 0


class RunNotes:
    """A sink that records the folder of a queue's scan, and whether a device could not be stopped."""

    def __init__(self) -> None:
        self.folder: Path | None = None
        self.unsafe = False

    def __call__(self, event: Event) -> None:
        if isinstance(event, RunStarted):
            self.folder = event.folder
        elif isinstance(event, StateEntered) and event.message == UNSAFE:
            self.unsafe = True


class QueueError(BeamlineError):
    """Some scans of a queue are incomplete; the exit code is that of the first of them."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.exit_code = code


def load_queue(
    files: Sequence[Path],
    overrides: Sequence[str],
    *,
    rehearse: bool = False,
    no_live: Callable[[str], None] | None = None,
) -> tuple[Config, ...]:
    """The scans of these configurations and tables, in their order.

    A table is a CSV file. Its first line names the columns: `config` for the file of a configuration (relative to the
    table), and keys of configurations, whose values replace those of the file. An empty cell changes nothing.

    Args:
        overrides: overrides for all scans; they take precedence over those in a table.
        rehearse, no_live: as of `load`.

    Raises:
        ConfigError: scans are impossible; the message lists each of them with its fault. Nothing was started.
    """
    scans, faults = [], []
    for file in files:
        try:
            rows = list(_rows(file)) if file.suffix.lower() == TABLE else [("", file, ())]
        except ConfigError as error:
            faults.append(str(error))
            continue
        for place, config_file, own in rows:
            try:
                scans.append(load(config_file, (*own, *overrides), rehearse=rehearse, no_live=no_live))
            except ConfigError as error:
                faults.append(f"{place}{error}")
    if faults:
        raise ConfigError(faults[0] if len(faults) == 1 else "".join(["the queue has faults:", *_indented(faults)]))
    return tuple(scans)


def _rows(table: Path) -> Iterator[tuple[str, Path, tuple[str, ...]]]:
    """Place, configuration and overrides of each line of a table."""
    try:
        reader = csv.reader(io.StringIO(text_in(table, SETTINGS), newline=""), strict=True)
        numbered = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except (OSError, csv.Error) as error:
        raise ConfigError(f"{table} cannot be read as a table ({error}). Nothing was started.") from None
    head = numbered[0][1] if numbered else []
    if _CONFIG not in head or "" in head or len(set(head)) < len(head) or not any(any(row) for _, row in numbered[1:]):
        raise ConfigError(
            f"{table} is not a table of scans. Expected a first line with the names of the columns, such as "
            "config,sample.name,scan.exposure_s, each only once, and then one line per scan. Nothing was "
            "started."
        )
    for number, row in numbered[1:]:
        if not any(row):
            continue
        cells = dict(zip(head, row, strict=False))
        if len(row) > len(head) or not cells.get(_CONFIG):
            raise ConfigError(
                f"{table}, line {number}: {','.join(row)!r} has {count(len(row), 'cell')}; expected {len(head)}, with "
                f"a file under {_CONFIG}. Nothing was started."
            )
        own = tuple(f"{key}={value}" for key, value in cells.items() if key != _CONFIG and value)
        yield f"{table}, line {number}: ", table.parent / cells[_CONFIG], own


@dataclass(frozen=True, eq=False)
class QueueNeeds:
    """Needs of the scans of a queue, computed without devices.

    Attributes:
        scans: by name.
        duration: total time in s, without changing samples.
        total_bytes: size of all files.
        free_bytes: free space on the fullest disk.
    """

    scans: Sequence[tuple[str, DryRun]]
    duration: float
    total_bytes: int
    free_bytes: int

    def lines(self) -> list[str]:
        """A line for each scan, and the sum."""
        rows = [
            (name, str((len(worked.energies) or 1) * worked.timeline.n_frames), size(worked.total_bytes),
             hms_text(_seconds(worked)))
            for name, worked in self.scans
        ]  # fmt: skip
        total = f"{size(self.total_bytes)} of {size(self.free_bytes)} free, {hms_text(self.duration)}"
        return [
            aligned([("scan", "frames", "size", "time"), *rows]),
            "",
            f"{count(len(self.scans), 'scan')}: {total}, plus the time between the scans",
        ]

    def data(self) -> Mapping[str, Any]:
        """The needs for programs: s and bytes of each scan and of all."""
        each = [{**worked.data(), "sample": name, "duration": _seconds(worked)} for name, worked in self.scans]
        totals = {"duration": self.duration, "total_bytes": self.total_bytes, "free_bytes": self.free_bytes}
        return {"scans": each, **totals}

    def refuse_impossible(self) -> None:
        """Raise ConfigError for scans that violate a limit, or do not fit on the disk together. Nothing was started."""
        faults = [f"{name}: {text}" for name, worked in self.scans for text in worked.timeline.violations]
        if not faults and self.total_bytes * ROOM > self.free_bytes:
            faults.append(
                f"{count(len(self.scans), 'scan')} need {size(self.total_bytes)} plus a reserve of a tenth, but "
                f"the disk has {size(self.free_bytes)} free. Free some space, or choose another storage.folder"
            )
        if faults:
            raise ConfigError(
                "".join(["Nothing was started, because some of the scans cannot run:", *_indented(faults)])
            )


def queue_needs(queue: Sequence[Config], place: Path | None) -> QueueNeeds:
    """Compute the needs of a queue without devices; `place` as in `run_scan`.

    Raises:
        ConfigError: a scan cannot be planned; the message names the first such scan.
    """
    scans = []
    for config in queue:
        try:
            scans.append((config.sample.name, dry_run(config, place)))
        except ConfigError as error:
            raise ConfigError(f"{config.sample.name}: {error}") from error
    needs = [(_seconds(worked), worked.total_bytes, worked.free_bytes) for _, worked in scans]
    seconds, sizes, free = zip(*needs, strict=True)
    return QueueNeeds(scans, sum(seconds), sum(sizes), min(free))


def run_queue(
    queue: Sequence[Config],
    take: Callable[[int, Config, StopRequest, RunNotes], Taken],
    *,
    stop_on_failure: bool = False,
) -> tuple[ScanOutcome, ...]:
    """Run the scans of a queue. If one fails, the next one still runs, unless `stop_on_failure`.

    The queue ends if the operator stops a scan (Ctrl-C, a signal, `beamline stop`), or if a device does not respond.

    Args:
        take: function that runs a scan, given its number from 0 on; it sends its events to its last argument, and
            raises the errors of `run_scan`.
    """
    outcomes: list[ScanOutcome] = []
    ended = ""
    for n, config in enumerate(queue):
        name = config.sample.name
        if ended:
            outcomes.append(ScanOutcome(name, QueueStatus.NOT_STARTED, None, ended, ScanStopped.exit_code))
            continue
        stop, run = StopRequest(), RunNotes()
        try:
            path, faults = take(n, config, stop, run)
        except (Exception, KeyboardInterrupt) as error:
            asked = stop.by_person or isinstance(error, KeyboardInterrupt)
            status = QueueStatus.STOPPED if asked else QueueStatus.FAILED
            outcomes.append(ScanOutcome(name, status, run.folder, user_message(error), exit_code(error)))
            ended = "the operator stopped the queue" if asked else f"{name} failed" if stop_on_failure else ""
        else:
            status = QueueStatus.ALARMS if faults else QueueStatus.COMPLETE
            outcomes.append(ScanOutcome(name, status, path, " ".join(faults), AlarmError.exit_code if faults else 0))
            ended = "the operator stopped the queue" if stop.by_person else ""
        if run.unsafe:
            ended = f"stage, camera or shutter did not respond at the end of {name}"
    return tuple(outcomes)


def summary(outcomes: Sequence[ScanOutcome]) -> list[str]:
    """A line for each scan."""
    return aligned([(each.name, each.status, str(each.path or ""), each.why) for each in outcomes]).split("\n")


def raise_unless_complete(outcomes: Sequence[ScanOutcome]) -> None:
    """Raise QueueError if a scan is incomplete; AlarmError if all are complete, and some have alarms."""
    bad = [outcome for outcome in outcomes if outcome.status not in (QueueStatus.COMPLETE, QueueStatus.ALARMS)]
    alarmed = [outcome for outcome in outcomes if outcome.status is QueueStatus.ALARMS]
    if bad:
        code = bad[0].exit_code
        whole = len(outcomes) - len(bad)
        others = ", ".join(f"{outcome.name} {outcome.status}" for outcome in bad)
        raise QueueError(f"{whole} of {len(outcomes)} scans are complete: {others}.", code)
    if alarmed:
        raise AlarmError(
            f"All scans are complete, but {alarmed[0].name}: {alarmed[0].why} Details are in {alarmed[0].path}."
        )


def _indented(lines: Sequence[str]) -> list[str]:
    return [f"\n  {line}" for line in lines]


def _seconds(worked: DryRun) -> float:
    return sum(need.duration for need in worked.energies) if worked.energies else worked.timeline.duration


def take_all(request: ScanRequest) -> None:
    """Run the scans of a queue, or compute their needs, and print the outcome of each."""
    with json_events(request.as_json) as json_sink:
        queue = load_queue(request.files, request.overrides, rehearse=request.rehearse, no_live=request.unless_live)
        needs = queue_needs(queue, request.output)
        if request.dry:
            if not request.as_json:
                click.echo("\n".join(needs.lines()))
            needs.refuse_impossible()
            json_sink(Done(needs.data(), time=SystemClock().now()))
            return
        needs.refuse_impossible()
        if request.wait and not sys.stdin.isatty():
            raise click.UsageError("--wait needs a terminal, because it asks before each scan. Nothing was started.")
        outcomes = run_queue(
            queue, partial(_take_next, request, len(queue), json_sink), stop_on_failure=request.stop_on_failure
        )
        json_sink(Done({"scans": [asdict(outcome) for outcome in outcomes]}, time=SystemClock().now()))
        if not request.as_json:
            click.echo("\n".join(summary(outcomes)))
        raise_unless_complete(outcomes)


def _take_next(
    request: ScanRequest, of: int, json_sink: Sink, n: int, config: Config, stop: StopRequest, run: RunNotes
) -> Taken:
    """Take the n-th scan of a queue of so many."""
    if request.wait and n:
        ask_operator(f"Scan {n + 1} of {of}: put the sample {config.sample.name} in place.")
    click.echo(f"Scan {n + 1} of {of}: {config.sample.name}", err=True)
    sinks: list[Sink] = [json_sink, run]
    if config.scan.energies is not None:
        done = take_energies(config, request, sinks, stop)
        return done.folder, [fault for result in done.results for fault in faults_of(result)]
    with ExitStack() as held:
        result = run_one(config, None, request, sinks, held, stop)
    if request.rehearse:
        click.echo("\n".join(rehearsed_lines(config, result, request)), err=True)
    return result.path, faults_of(result)
