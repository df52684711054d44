"""Narration: events as sentences for people."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TextIO

from beamline.core.events import (
    BlockDone,
    BlockStarted,
    EnoughReached,
    Event,
    Failed,
    FrameFlagged,
    ReconDone,
    ReconStarted,
    RunDone,
    RunStarted,
    ScanDone,
    SnapshotWritten,
    StateEntered,
    StudyStarted,
    TradeoffStarted,
    TrialDone,
    Warned,
)
from beamline.core.text import size, spans


def sentence(event: Event) -> str | None:
    """The event as a sentence; None for events that only update a progress display."""
    match event:
        case RunStarted(folder, _, _, n, duration, total_bytes):
            return f"Run {folder}: {n} frames, {size(total_bytes)}, {duration:.0f} s"
        case StateEntered(message=message):
            return message or None
        case Warned(message):
            return f"Warning: {message}"
        case BlockStarted(kind, mode, n, exposure=exposure):
            return f"{n} {kind} frames ({mode}, {exposure:g} s each)"
        case BlockDone():
            return _missing(event)
        case FrameFlagged(flag):
            return f"{flag.level.capitalize()} ({flag.check}, frame {flag.frame}): {flag.advice}"
        case ReconStarted():
            again = " again, from the start" if event.again else ""
            return f"{event.method}{again}: {event.n_views} views, rotation axis at column {event.axis_col:.2f}"
        case TradeoffStarted(file, trials, by):
            return f"{trials} trials of {file}, quality by {by}"
        case StudyStarted(file, rows, study=study):
            return f"{study}: {rows} reconstructions of {file}"
        case TrialDone():
            return _trial(event)
        case SnapshotWritten(path, n_views=n_views):
            return f"Volume from {n_views} views so far: {path}"
        case EnoughReached(n, planned, mean, low, high):
            spread = f"{mean:.2f} dB ({low:.2f} to {high:.2f})"
            return f"Enough views: {n} of {planned}; the others would add {spread}"
        case ScanDone(scan):
            alarms = f", {scan.alarmed_frames} WITH AN ALARM" if scan.alarmed_frames else ""
            again = f", {scan.retaken} views taken again" if scan.retaken else ""
            head = f"Scan {scan.status}: {scan.n_frames} frames{again}{alarms}, {size(scan.bytes)}"
            return f"{head}, {scan.seconds:.1f} s: {scan.path}"
        case ReconDone(values):
            return f"Volume: {values.get('output', '')}"
        case Failed(message):
            return f"Failed: {message}"
        case RunDone(folder):
            return f"Done: {folder}"
    return None


class UserLog:
    """A sink that writes each event's sentence with its UTC time."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __call__(self, event: Event) -> None:
        text = sentence(event)
        if text:
            stamp = datetime.fromtimestamp(event.time, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
            self._stream.write(f"{stamp}  {text}\n")
            self._stream.flush()


def _trial(trial: TrialDone) -> str:
    begin = f"{trial.n}/{trial.of} {trial.label}: "
    if trial.status != "done":
        return begin + f"{trial.status}: {trial.message}"
    quality = f", {trial.quality_db:.2f} dB" if math.isfinite(trial.quality_db) else ""
    memory = "" if trial.peak_bytes is None else f", {size(trial.peak_bytes)}"
    return begin + f"{trial.seconds:.2f} s{quality}{memory}"


def _missing(block: BlockDone) -> str | None:
    parts = [f"{len(block.missing)} missing ({spans(block.missing)})"] if block.missing else []
    parts += [f"{block.extra} without a trigger"] if block.extra else []
    return f"Of {block.n} {block.kind} frames: {', '.join(parts)}" if parts else None
