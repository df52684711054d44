"""Sinks, which receive events: they write JSON lines or sentences for people, combine several sinks, collect warnings,
or pass events on in a separate thread."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from queue import SimpleQueue
from typing import Any, Self, TextIO

from beamline.core.events import (
    BlockDone,
    BlockStarted,
    Done,
    Event,
    Failed,
    FrameFlagged,
    FrameStored,
    NextChosen,
    PassEnded,
    RunDone,
    RunStarted,
    ScanDone,
    Sink,
    StateEntered,
    Warned,
)
from beamline.core.flag import Level
from beamline.core.recon_events import (
    ReconDone,
    ReconStarted,
    SnapshotWritten,
    TrialDone,
    TrialsStarted,
)
from beamline.core.text import SENTENCE, count, one_line, size, spans
from drivers.base.clock import Clock


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
            return f"Taking {n} {kind} frames ({mode}, exposure {exposure:g} s)"
        case BlockDone():
            return _missing(event)
        case FrameFlagged(flag):
            frames_text = "frame" if len(flag.frames) == 1 else f"{len(flag.frames)} frames, {flag.frames.start} to"
            return f"{flag.level.capitalize()} ({flag.check}, {frames_text} {flag.frame}): {flag.advice}"
        case PassEnded():
            return "\n".join(lines(event))
        case NextChosen():
            return _decision(event)
        case ScanDone(scan):
            alarms = f", {scan.alarmed_frames} WITH AN ALARM" if scan.alarmed_frames else ""
            retaken_text = f", {count(scan.retaken, 'projection')} taken again" if scan.retaken else ""
            head = f"Scan {scan.status}: {scan.n_frames} frames{retaken_text}{alarms}, {size(scan.bytes)}"
            return f"{head}, {scan.seconds:.1f} s: {scan.path}"
        case Failed(message):
            return f"Failed: {message}"
        case RunDone(folder):
            return f"Done: {folder}"
    return _of_reconstruction(event)


def _of_reconstruction(event: Event) -> str | None:
    """The sentence of an event of `recon_events`."""
    match event:
        case ReconStarted():
            start_text = "starts again from the beginning" if event.again else "starts"
            views = count(event.n_views, "projection")
            return f"{event.method} {start_text}: {views}, rotation axis at column {event.axis_col:.2f}"
        case TrialsStarted(file, trials=trials, by=by):
            return (
                f"Starting {count(trials, 'trial reconstruction')} of {file}; the quality of each volume is "
                f"measured by {by}"
            )
        case TrialDone():
            return _trial(event)
        case SnapshotWritten(path, n_views=n_views):
            return f"Volume from the first {count(n_views, 'projection')}: {path}"
        case ReconDone(values):
            return f"Volume: {values.get('output', '')}"
    return None


def lines(event: Event) -> list[str]:
    """The event as lines for people: a table if a pass has ended, otherwise the sentence of the event; [] if it has no
    sentence."""
    if isinstance(event, PassEnded):
        return [*_table_of_options(event)]
    text = sentence(event)
    return [] if text is None else [one_line(text, SENTENCE)]


# a finding has ended if it is absent for this many frames; a finding that continues is reported at least every 8
# projections
_OVER = 32
_HELD = 60.0  # a finding that continues is reported, with its frames so far, this many s after its first event


class Narration:
    """Passes on events for people, and joins repeated findings on further frames into one event.

    The joined event is passed on when the finding has ended, `_HELD` s after its first event, or before a block or a
    command ends.
    """

    def __init__(self) -> None:
        # for each check: a finding that continues, with all of its frames so far
        self._open: dict[str, FrameFlagged] = {}

    def __call__(self, event: Event) -> Iterator[Event]:
        """The events that must be passed on now."""
        if isinstance(event, FrameFlagged) and event.flag.first is not None and event.flag.level != Level.ALARM:
            flag, known = event.flag, self._open.get(event.flag.check, event)
            if flag.frames.start > known.flag.frame + 1 or event.time - known.time >= _HELD:
                yield self._open.pop(flag.check)
                known = event
            flag = replace(flag, first=min(known.flag.frames.start, flag.frames.start))
            self._open[flag.check] = replace(event, flag=flag, time=known.time)
            return
        now = (
            event.n - _OVER
            if isinstance(event, FrameStored)
            else math.inf
            if isinstance(event, BlockDone | ScanDone | Failed | Done | RunDone)
            else 0
        )
        yield from map(self._open.pop, [check for check, known in self._open.items() if known.flag.frame < now])
        yield event


class UserLog:
    """A sink that writes the lines of each event, with its UTC time."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._narrated = stream, Narration()

    def __call__(self, event: Event) -> None:
        for each in self._narrated(event):
            for line in lines(each):
                stamp = datetime.fromtimestamp(each.time, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
                self._stream.write(f"{stamp}  {line}\n")
            self._stream.flush()


def _trial(trial: TrialDone) -> str:
    begin = f"{trial.n}/{trial.of} {trial.label}: "
    if trial.status != "done":
        return begin + f"{trial.status}: {trial.message}"
    quality = f", {trial.quality_db:.2f} dB" if math.isfinite(trial.quality_db) else ""
    memory = "" if trial.peak_bytes is None else f", {size(trial.peak_bytes)}"
    return begin + f"{trial.seconds:.2f} s{quality}{memory}"


def _table_of_options(ended: PassEnded) -> Iterator[str]:
    """Lines of at most 80 characters: a table of the options for the next measurement, and how the operator answers."""
    number = ended.passes or ended.number  # `number` in files of earlier versions
    yield f"Pass {number} is done, {count(ended.n_views, 'projection')} so far. What can be measured next:"
    yield f"  {'choice':<7}{'gain, dB':<22}{'dB/min':>8}{'s':>9}{'dose':>9}{'data':>10}"
    for option in ended.options:
        mark, choice = "> " if option["choice"] == ended.recommended else "  ", one_line(str(option["choice"]))
        cost = f"{option['seconds']:>9.0f}{100 * option['dose']:>7.1f} %{size(option['bytes']):>10}"
        yield "{}{:<7}{:<22}{:>8}{}".format(mark, choice, *_gain(option), cost)
    if ended.remark:
        yield one_line(ended.remark, SENTENCE)
    if ended.wait:
        yield f"Answer within {ended.wait:.0f} s: beamline decide CHOICE, or Enter for {one_line(ended.recommended)}."
        yield "Without an answer, the scan continues as planned."


def _gain(option: Mapping[str, Any]) -> tuple[str, str]:
    """The expected improvement by an option, with its range, and in dB per minute."""
    gain, low, high, seconds = (option[name] for name in ("gain", "low", "high", "seconds"))
    if gain is None:
        return "not known", "-"
    ends = "" if low == high else f" ({low:.2f} to {high:.2f})"
    return f"{gain:+.2f}{ends}", f"{60 * gain / seconds:+.2f}" if seconds else "-"


_BY = {"program": "chosen by the program: ", "plan": "as planned: "}  # if the operator chose, the reason says so


def _decision(chosen: NextChosen) -> str:
    decision = f"After pass {chosen.passes or chosen.number}: {chosen.choice}, {_BY.get(chosen.by, '')}{chosen.reason}"
    if chosen.gained is None:
        return decision
    predicted = "" if chosen.predicted is None else f"predicted {chosen.predicted:+.2f} dB, "
    ends = "" if None in (low := chosen.gained_low, high := chosen.gained_high) else f" ({low:.2f} to {high:.2f})"
    return (
        f"{decision.rstrip('.')}. Improvement of the PSNR by an earlier choice: {predicted}measured "
        f"{chosen.gained:+.2f} dB{ends}"
    )


def _missing(block: BlockDone) -> str | None:
    parts = [f"{len(block.missing)} missing ({spans(block.missing)})"] if block.missing else []
    parts += [f"{block.extra} extra, without a trigger"] if block.extra else []
    return f"Of {block.n} {block.kind} frames: {', '.join(parts)}" if parts else None


# Function that takes a sentence about something that is wrong, although the work continues
Warn = Callable[[str], None]


class Note(str):
    """A sentence that reports what was done although nothing is wrong. It becomes an event `state` and not a
    warning."""


def event_of_sentence(text: str, now: float) -> Event:
    """The event of a sentence: a warning, or a state for a `Note`."""
    return StateEntered("note", text, time=now) if isinstance(text, Note) else Warned(text, time=now)


class JsonLines:
    """A sink that writes one JSON line per event and flushes it, so that a crash does not lose earlier events."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __call__(self, event: Event) -> None:
        self._stream.write(event.to_json() + "\n")
        self._stream.flush()


def fan_out(*sinks: Sink) -> Sink:
    """A sink that passes each event to all of `sinks`, in order."""

    def send(event: Event) -> None:
        for sink in sinks:
            sink(event)

    return send


def while_it_works(sink: Sink, others: Sink) -> Sink:
    """Pass events to a sink until the sink raises an error (a full disk, a closed pipe). Then warn the sinks `others`
    once."""
    works = True

    def send(event: Event) -> None:
        nonlocal works
        if not works:
            return
        try:
            sink(event)
        except (
            BaseException
        ) as error:  # the sink may be any code; SystemExit from it would end the announcer without a message
            if isinstance(error, KeyboardInterrupt) and threading.current_thread() is threading.main_thread():
                raise  # Ctrl-C
            works = False
            reason = f"{type(error).__name__}: {error}"
            others(
                Warned(
                    "The work continues, but one of the outputs for progress or logs failed and gets no more "
                    f"messages: {reason}",
                    time=event.time,
                )
            )

    return send


class Warnings:
    """Sends each warning or note once, as an event, and collects it in `messages` for the report."""

    def __init__(self, sink: Sink, clock: Clock) -> None:
        self._sink, self._clock = sink, clock
        self.messages: list[str] = []

    def __call__(self, text: str) -> None:
        if text not in self.messages:
            self.messages.append(text)
            self._sink(event_of_sentence(text, self._clock.now()))

    def withdraw(self, beginning: str) -> None:
        """Remove the messages that begin with `beginning` from the report; call it when they are no longer true."""
        self.messages = [text for text in self.messages if not text.startswith(beginning)]


_PATIENCE = 10.0  # s


class Announcer:
    """Passes events to sinks in a separate thread. Leaving the context waits until all events have been passed on.

    The context waits at most `_PATIENCE` s, so that the program can end even if nobody reads the terminal or pipe. A
    sink that raises an error (closed pipe, full disk) gets no further events, and the other sinks get a warning.
    """

    def __init__(self, sinks: Sequence[Sink], clock: Clock) -> None:
        self._sinks, self._clock = [while_it_works(sink, self._send) for sink in sinks], clock
        self._queue: SimpleQueue[Event | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._deliver, name="announcer", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._queue.put(None)
        self._thread.join(_PATIENCE)

    def __call__(self, event: Event) -> None:
        """Queue the event with the current time; returns at once."""
        self._queue.put(replace(event, time=self._clock.now()))

    def _deliver(self) -> None:
        while (event := self._queue.get()) is not None:
            self._send(event)

    def _send(self, event: Event) -> None:
        for sink in self._sinks:
            sink(event)
