"""`beamline scan` of several configurations, or of a table of them."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial

import click

from beamline.cli.options import json_events
from beamline.cli.scan import ScanRequest, faults_of, rehearsed_lines, run_one, take_energies
from beamline.core.events import Done, Sink
from beamline.core.stop import StopRequest
from beamline.features.queue.queue import (
    QueuedScan,
    RecordedScan,
    RunNotes,
    load_queue,
    queue_needs,
    raise_unless_complete,
    run_queue,
    summary,
)
from beamline.instrument.operator import ask_operator
from drivers.base.clock import SystemClock


def take_all(request: ScanRequest) -> None:
    """Take the scans of a queue, or work them out, and print what became of each."""
    with json_events(request.as_json) as json_sink:
        queue = load_queue(request.files, request.overrides, rehearse=request.rehearse)
        needs = queue_needs(queue, request.output)
        if request.dry:
            if not request.as_json:
                click.echo("\n".join(needs.lines()))
            needs.refuse_impossible()
            json_sink(Done(needs.data(), time=SystemClock().now()))
            return
        needs.refuse_impossible()
        if request.wait and not sys.stdin.isatty():
            raise click.UsageError("--wait asks before each sample: it needs a terminal. Nothing was started.")
        outcomes = run_queue(
            queue, partial(_take_next, request, len(queue), json_sink), stop_on_failure=request.stop_on_failure
        )
        json_sink(Done({"scans": [asdict(outcome) for outcome in outcomes]}, time=SystemClock().now()))
        if not request.as_json:
            click.echo("\n".join(summary(outcomes)))
        raise_unless_complete(outcomes)


def _take_next(
    request: ScanRequest, of: int, json_sink: Sink, n: int, waiting: QueuedScan, stop: StopRequest, run: RunNotes
) -> RecordedScan:
    """Take the n-th scan of a queue of so many."""
    if request.wait and n:
        ask_operator(f"Scan {n + 1} of {of}: bring {waiting.name} to its place.")
    click.echo(f"Scan {n + 1} of {of}: {waiting.name}", err=True)
    sinks: list[Sink] = [json_sink, run]
    if waiting.config.scan.energies is not None:
        done = take_energies(waiting.config, request, sinks, stop)
        return RecordedScan(done.folder, tuple(fault for result in done.results for fault in faults_of(result)))
    with ExitStack() as held:
        result = run_one(waiting.config, None, request, sinks, held, stop)
    if request.rehearse:
        click.echo("\n".join(rehearsed_lines(waiting.config, result, request)), err=True)
    return RecordedScan(result.path, tuple(faults_of(result)))
