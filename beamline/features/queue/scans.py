"""`beamline scan` with several configurations, or with a table of them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path

import click

from beamline.cli.options import json_events
from beamline.cli.scan import ScanRequest, faults_of, rehearsed_lines, run_one, take_series
from beamline.config.load import Config
from beamline.core.errors import AlarmError, BeamlineError, ConfigError, ScanStopped, exit_code, user_message
from beamline.core.events import Done, Event, Failed, RunStarted, Sink, StateEntered
from beamline.core.stop import StopRequest
from beamline.core.text import aligned
from beamline.instrument.connect import ask_operator
from beamline.scan.moves import UNSAFE
from beamline.scan.queue_plan import QueuePlan
from beamline.scan.queue_planning import plan_queue
from drivers.base.clock import SystemClock


class QueueStatus(StrEnum):
    """The outcome of a scan of a queue."""

    COMPLETE = "complete"
    ALARMS = "alarms"
    FAILED = "failed"
    STOPPED = "stopped"
    NOT_STARTED = "not started"


Taken = tuple[Path, Sequence[str]]
"""A finished scan, or series of scans: its path, and the faults of its frames, a sentence each."""


@dataclass(frozen=True)
class ScanOutcome:
    """Outcome of a scan of a queue: how it ended, where its files are, and why it is incomplete."""

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
    """Some scans of a queue are incomplete. The exit code is that of the first incomplete scan."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.exit_code = code


def run_queue(
    queue: Sequence[Config],
    take: Callable[[int, Config, StopRequest, RunNotes], Taken],
    *,
    stop_on_failure: bool = False,
) -> tuple[ScanOutcome, ...]:
    """Run the scans of a queue. If one fails, the next one still runs, unless `stop_on_failure`.

    The queue ends if the operator stops a scan (Ctrl-C, a signal, `beamline stop`), or if a device does not respond.

    Args:
        take: function that runs the scan with a given number (from 0). It sends events to its last argument, and raises
            the errors of `run_scan`.
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
            by_operator = stop.by_person or isinstance(error, KeyboardInterrupt)
            status = QueueStatus.STOPPED if by_operator else QueueStatus.FAILED
            outcomes.append(ScanOutcome(name, status, run.folder, user_message(error), exit_code(error)))
            ended = "the operator stopped the queue" if by_operator else f"{name} failed" if stop_on_failure else ""
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
    """Raise QueueError if a scan is incomplete. Raise AlarmError if all scans are complete, but some have alarms."""
    bad = [outcome for outcome in outcomes if outcome.status not in (QueueStatus.COMPLETE, QueueStatus.ALARMS)]
    alarmed = [outcome for outcome in outcomes if outcome.status is QueueStatus.ALARMS]
    if bad:
        code = bad[0].exit_code
        whole = len(outcomes) - len(bad)
        others = ", ".join(f"{outcome.name} {outcome.status}" for outcome in bad)
        raise QueueError(f"{whole} of {len(outcomes)} scans are complete: {others}.", code)
    if alarmed:
        scan_name = alarmed[0].name
        fault = alarmed[0].why
        folder = alarmed[0].path
        raise AlarmError(f"All scans are complete, but {scan_name}: {fault} Details are in {folder}.")


def take_all(request: ScanRequest) -> None:
    """Plan the scans of a queue, then run them, and print the outcome of each."""
    with json_events(request.as_json) as json_sink:
        plan = plan_queue(
            request.files, request.settings, place=request.output, rehearse=request.rehearse,
            no_live=request.unless_live,
        )  # fmt: skip
        for scan in plan.scans:
            for sentence in scan.warnings:
                click.echo(f"Warning: {scan.source}: {sentence}", err=True)
        if request.dry:
            _show(plan, json_sink, request.as_json)
            return
        plan.refuse_impossible()
        if request.wait and not sys.stdin.isatty():
            raise click.UsageError("--wait needs a terminal, because it asks before each scan. Nothing was started.")
        queue = [scan.config for scan in plan.scans if scan.config is not None]
        outcomes = run_queue(
            queue, partial(_take_next, request, len(queue), json_sink), stop_on_failure=request.stop_on_failure
        )
        json_sink(Done({"scans": [asdict(outcome) for outcome in outcomes]}, time=SystemClock().now()))
        if not request.as_json:
            click.echo("\n".join(summary(outcomes)))
        raise_unless_complete(outcomes)


def _show(plan: QueuePlan, json_sink: Sink, as_json: bool) -> None:
    """Print the plan. Raises ConfigError if a scan cannot run. The event of this error also has the plan."""
    if not as_json:
        click.echo("\n".join(plan.lines()))
    try:
        plan.refuse_impossible()
    except ConfigError as error:
        json_sink(Failed(str(error), exit_code(error), more=plan.data(), time=SystemClock().now()))
        raise
    json_sink(Done(plan.data(), time=SystemClock().now()))


def _take_next(
    request: ScanRequest, n_scans: int, json_sink: Sink, n: int, config: Config, stop: StopRequest, run: RunNotes
) -> Taken:
    """Run the n-th of the scans of a queue."""
    if request.wait and n:
        number = n + 1
        ask_operator(f"Scan {number} of {n_scans}: put the sample {config.sample.name} in place.")
    click.echo(f"Scan {n + 1} of {n_scans}: {config.sample.name}", err=True)
    sinks: list[Sink] = [json_sink, run]
    if config.series:
        done = take_series(config, request, sinks, stop)
        return done.folder, [fault for result in done.results for fault in faults_of(result)]
    with ExitStack() as held:
        result = run_one(config, None, request, sinks, held, stop)
    if request.rehearse:
        click.echo("\n".join(rehearsed_lines(config, result, request)), err=True)
    return result.path, faults_of(result)
