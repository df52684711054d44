"""`beamline monitor`: checks every frame of a scan file with the checks that also run during a scan."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.options import json_option, others, scan_argument, set_by, set_option, with_request
from beamline.cli.recipe import DATA, Grouped, heading
from beamline.cli.selection_options import scan_options
from beamline.cli.terminal import counting, events_shown
from beamline.core.errors import AlarmError, ScanStopped
from beamline.core.events import Done, FrameFlagged, Sink, Warned
from beamline.core.files import refuse_existing, write_whole
from beamline.core.stop import StopOnSignal
from beamline.core.text import SENTENCE, count, frames_text, one_line, spans
from drivers.base.clock import Clock, SystemClock

if TYPE_CHECKING:
    from beamline.monitor.check import Check, Level
    from beamline.monitor.references import ReferenceLimits
    from beamline.projections.replay import FlagKind, FrameVerdict, ScanVerdict


@dataclass(frozen=True, eq=False)
class MonitorRequest:
    """The arguments of `beamline monitor`."""

    file: Path = set_by(scan_argument)
    follow: bool = set_by("--follow", is_flag=True, help="Check a scan that is still running, until it ends.")
    config: Path | None = set_by(
        "--config",
        type=click.Path(path_type=Path),
        help="Configuration whose sections `monitor` and `references` set the limits. Default: the limits in "
        "docs/monitor.md.",
    )
    overrides: tuple[str, ...] = set_by(set_option)
    sheet: Path | None = set_by(
        "--sheet",
        type=click.Path(path_type=Path, dir_okay=False),
        help="Write a picture of the worst frames, with the flagged regions marked, to this new PNG file.",
    )
    values: Mapping[str, Any] = others(scan_options)
    as_json: bool = set_by(json_option)


@click.command(
    cls=Grouped,
    first=("follow", "config", "overrides", "sheet", "angles", "darks", "flats", "quantity", "data_path", "as_json"),
)
@heading(DATA)
@with_request(MonitorRequest)
def monitor(request: MonitorRequest) -> None:
    """Check every frame of the scan in FILE, as the monitor does during a scan.

    \b
    beamline monitor SCAN.h5
    beamline monitor SCAN.h5 --sheet worst.png    also draw the worst frames

    FILE may have any format that `beamline recon` reads, and is not changed. For each check the command prints the
    flagged frames, the worst score with its limit, the place in the frame and what to do. The command also prints how
    many projections each check had to skip, and why.

    Exit code: 0 no alarm; 4 the command was stopped; 7 at least one frame has an alarm, or darks or flats have a fault.
    """
    from beamline.config.load import load
    from beamline.config.monitor import configured_checks, reference_limits
    from beamline.monitor.checks import CHECKS

    if request.overrides and request.config is None:
        raise click.UsageError("--set changes a value of a configuration: add --config.")
    if request.sheet is not None:
        refuse_existing(request.sheet)
    clock = SystemClock()
    with events_shown(request.as_json) as sink:
        checks, limits = CHECKS, None
        if request.config is not None:
            read = load(request.config, request.overrides)
            checks, limits = configured_checks(read.monitor), reference_limits(read.references)
        watched = _watched(request, checks, limits, sink, clock)
        summed = watched.verdict
        altered = [summed.altered] if summed.altered else []
        for fault in [*summed.references, *altered, *watched.ended]:
            sink(Warned(fault, time=clock.now()))
        sink(Done(_facts(request.file, summed), time=clock.now()))
    n, alarmed, references = summed.n_frames, summed.alarmed, summed.references
    if not request.as_json:
        click.echo("\n".join(_in_lines(request.file, watched)))
    if watched.stopped:
        raise ScanStopped(f"{request.file}: stopped after {n} frames.")
    if alarmed or references:
        faults = f"; groups of darks or flats with a fault: {len(references)}" if references else ""
        raise AlarmError(
            f"{request.file}: {len(alarmed)} of {n} frames have an alarm{faults}. The list of these frames is on "
            f"stdout."
        )


@dataclass(frozen=True, eq=False)
class _Watched:
    """Result of the checks of a scan: the verdict, how the scan ended, and whether the command was stopped."""

    verdict: ScanVerdict
    ended: Sequence[str]
    stopped: bool


def _in_lines(file: Path, watched: _Watched) -> list[str]:
    """The verdict on a scan, as lines for the terminal."""
    from beamline.storage.flag_legend import counted

    summed = watched.verdict
    end = f"{one_line(str(file), SENTENCE)}: {summed.n_frames} frames, flagged: {counted(summed.flags)}"
    if retaken := summed.retaken:
        end += f"; not counted, because the scan took these projections again: {frames_text(retaken)}"
    altered = [summed.altered] if summed.altered else []
    left_out = [f"Not checked: {'; '.join(summed.aside)}."] if summed.aside else []
    return [*table(summed.kinds), *summed.references, *altered, *left_out, *watched.ended, end]


def _watched(
    request: MonitorRequest, checks: Sequence[Check], limits: ReferenceLimits | None, sink: Sink, clock: Clock
) -> _Watched:
    """Check every frame, report its flags, and write the picture of the worst frames if the user asked for it."""
    from beamline.projections.replay import replay, verdict
    from beamline.storage.flag_legend import FrameFlags
    from beamline.storage.readers.open import SourceOptions
    from beamline.storage.rules.evidence import ScanEvidence
    from beamline.storage.rules.scan import scan_ended

    progress, follow = counting("monitor", sink, clock), clock if request.follow else None
    frames: list[FrameVerdict] = []
    active: set[tuple[str, Level]] = set()
    stopping, opened = StopOnSignal("Stopping."), SourceOptions(request.file, **request.values)
    with opened.open(follow=request.follow) as source, stopping() as stopped:
        for judged in replay(source, checks, follow=follow, should_stop=stopped):
            frames.append(judged)
            if not request.follow:
                progress(len(frames), judged.n_frames)
            now = {(flag.check, flag.level) for flag in judged.flags}
            for flag in judged.flags:
                if (flag.check, flag.level) not in active:
                    sink(FrameFlagged(flag, time=clock.now()))
            active = now
        summed = verdict(source, frames, limits)
        ended = [finding.message for finding in scan_ended(ScanEvidence(source))]
        if request.sheet is not None:
            from beamline.reconstruct.scan_facts import worst_frames

            worst = worst_frames(source, FrameFlags.of_flags([judged.flags for judged in frames]))
            if worst:
                from beamline.report.sheets import contact_sheet

                write_whole(request.sheet, contact_sheet(worst))
        return _Watched(summed, ended, stopped())


def _facts(file: Path, summed: ScanVerdict) -> dict[str, Any]:
    """The contents of the event `done`."""
    return {
        "file": file, "n_frames": summed.n_frames, "alarmed_frames": len(summed.alarmed),
        "retaken": len(summed.retaken), "flags": summed.flags, "references": summed.references,
        "aside": summed.aside,
        "kinds": [{**asdict(kind.worst), "frames": kind.frames} for kind in summed.kinds],
    }  # fmt: skip


def table(kinds: Iterable[FlagKind]) -> list[str]:
    """The flags as text, with three lines for each check and level."""
    from beamline.monitor.checks import CHECKS

    units, lines = {check.name: check.unit for check in CHECKS}, []
    for kind in kinds:
        worst = kind.worst
        region_text = ""
        if worst.region is not None:
            top, bottom, left, right = worst.region
            region_text = f", rows {top}-{bottom - 1}, columns {left}-{right - 1}"
        unit_text = units[kind.check]
        lines += [
            f"{kind.level:<6}{kind.check:<12}{count(len(kind.frames), 'frame')}: {spans(kind.frames)}",
            f"{'':<18}worst score {worst.score:.4g} (limit {worst.limit:.4g} {unit_text}), in frame "
            f"{worst.frame}{region_text}",
            f"{'':<18}{worst.advice}",
        ]
    return lines
