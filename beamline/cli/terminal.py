"""Output for people: events as a progress bar or plain lines on stderr, the result of a reconstruction as text."""

from __future__ import annotations

import errno
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from datetime import UTC, datetime
from types import TracebackType
from typing import Any, Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from beamline.core.events import Event, Sink
from beamline.core.narration import sentence
from beamline.core.text import printable
from beamline.report.metrics import METRICS, formatted
from drivers.base.clock import Clock
from drivers.manual import Ask
from recon.methods import BASELINE

LONG = 2.0
"""Real s after which a phase that tells no progress is named on a stream that is no terminal."""
SAY_EVERY = 0.2
"""s between events on how far many frames are."""
PLAIN_EVERY = 5.0
"""Real s between progress lines on a stream that is no terminal."""
_OF_FRAMES = ("ingest", "xafs", "monitor", "correction", "validate")  # stages whose progress counts frames
_OF_ITSELF = ("axes", "slices", "views")  # stages named after what their progress counts
_OF_TRIALS = {
    "tradeoff": "trials",
    "study": "trials",
    "batch": "scans",
    "bench": "runs",
}  # stage: what its progress counts


class Terminal:
    """A sink that prints events. Leaving it as a context manager removes the progress bar.

    Args:
        stream: to print to (stderr: results belong to stdout). A terminal gets a bar, anything else plain lines.
    """

    def __init__(self, stream: TextIO) -> None:
        self._console = Console(file=stream, highlight=False, markup=False, soft_wrap=True)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=self._console,
            transient=True,
            disable=not self._console.is_terminal,
        )
        self._tasks: dict[str, TaskID] = {}
        self._printed: dict[str, tuple[float, int]] = {}  # real s and frame or step of the last line
        self._last_text = ""
        self._lock = threading.Lock()  # events come from one thread, questions from another
        self._asking = False
        self._long: threading.Timer | None = None  # names the phase when it has taken LONG

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end_of_phase()
        with _closed_terminal_ignored():
            self._bar.stop()

    def ask(self, request: str, put: Ask) -> None:
        """Show a request to the operator without the progress bar, and wait until `put` returns."""
        with self._lock:
            self._bar.stop()
            self._asking = True
        try:
            put(request)
        finally:
            self._asking = False

    def __call__(self, event: Event) -> None:
        with self._lock, _closed_terminal_ignored():
            self._take(event)

    def say(self, text: str) -> None:
        """Print a line that is no event."""
        with self._lock, _closed_terminal_ignored():
            self._console.print(printable(text))

    def _take(self, event: Event) -> None:
        self._end_of_phase()
        if event.event == "frame":
            self._show("scan", event.data["n"], event.data["of"], rates(event.data))
        elif event.event == "progress" and event.data.get("stage") in _OF_FRAMES:
            self._show("frames", event.data["n"], event.data["of"], rate_text(event.data))
        elif event.event == "progress" and event.data.get("stage") == "archive":
            self._show("written and compared", event.data["n"], event.data["of"], rate_text(event.data, "MB"))
        elif event.event == "progress" and event.data.get("stage") == "phase":
            self._show_phase(event.data)
        elif event.event == "progress" and event.data.get("stage") in _OF_ITSELF:
            what = event.data["stage"]
            self._show(what, event.data["n"], event.data["of"], rate_text(event.data, what))
        elif event.event == "progress" and event.data.get("stage") in _OF_TRIALS:
            what = _OF_TRIALS[event.data["stage"]]
            self._show(what, event.data["n"], event.data["of"], trials(event.data, what))
        elif event.event == "progress" and event.data.get("stage") == "kernels":
            note = f"{event.data['n']} compiled in {event.data['seconds']:.0f} s; once on a machine, 1 to 2 minutes"
            self._show("kernels", event.data["n"], 0, note)
        elif event.event == "progress":
            self._show("volume", event.data["step"], event.data["steps"], fit(event.data))
        elif event.event not in ("failed", "done"):  # the command prints these itself
            text = sentence(event)
            if text and text != self._last_text:  # a snapshot of the same views replaces the one before
                self._last_text = text
                self._console.print(printable(text))

    def _show_phase(self, data: Mapping[str, Any]) -> None:
        if data["n"] or not self._bar.disable:
            self._show(data["phase"], data["n"], data["of"], phase_text(data))
            return
        self._long = threading.Timer(LONG, self.say, [f"{data['phase']}: begun {LONG:.0f} s ago"])
        self._long.daemon = True
        self._long.start()

    def _end_of_phase(self) -> None:
        if self._long is not None:
            self._long.cancel()
            self._long = None

    def _show(self, what: str, done: int, total: int, note: str) -> None:
        if self._asking:
            return
        if not self._bar.disable:
            self._bar.start()
            if what not in self._tasks:
                self._tasks[what] = self._bar.add_task(what, note=note)
            self._bar.update(self._tasks[what], completed=done, total=total or None, note=note)
            return
        now = time.monotonic()
        last, at = self._printed.get(what, (-PLAIN_EVERY, -1))
        if done == at == total:
            return
        if now - last >= PLAIN_EVERY or done == total:
            self._printed[what] = now, done
            self._console.print(f"{what}: {note}")


@contextmanager
def _closed_terminal_ignored() -> Iterator[None]:
    """Errors from a terminal that was closed are ignored, so that the work goes on."""
    try:
        yield
    except OSError as error:
        if error.errno != errno.EIO:
            raise


class LogLines:
    """A sink that writes every event as a line: time, kind, and the sentence for people or else its values.

    Where `terminal`, errors of one that was closed are ignored; from a file the same error is one of its disk.
    """

    def __init__(self, stream: TextIO, *, terminal: bool = False) -> None:
        self._stream, self._lock = stream, threading.Lock()
        self._ignored = _closed_terminal_ignored if terminal else nullcontext

    def __call__(self, event: Event) -> None:
        said = sentence(event) if event.event not in ("done", "recon_started") else None
        if said is None:
            said = ", ".join(f"{name} {value}" for name, value in event.data.items())
        at = datetime.fromtimestamp(event.time, UTC).isoformat(timespec="milliseconds")
        with self._lock, self._ignored():
            self._stream.write(f"{at}  {event.event}: {printable(' '.join(said.split()))}\n")
            self._stream.flush()


def rates(data: Mapping[str, Any]) -> str:
    """n/N, frames/s, MB/s and the time left, of a `frame` event."""
    speed = f"{data['frames_per_s']:.1f} frames/s  {data['mb_per_s']:.1f} MB/s"
    return f"{data['n']}/{data['of']}  {speed}  {_clock_time(data['eta_s'])} left"


def rate_text(data: Mapping[str, Any], what: str = "frames") -> str:
    """n/N, frames/s and the time left, of a `progress` event of a copy, an energy scan or trials of axes."""
    return f"{data['n']}/{data['of']}  {data['per_s']:.1f} {what}/s  {_clock_time(data['eta_s'])} left"


def phase_text(data: Mapping[str, Any]) -> str:
    """n/N, rate and time left, of a `progress` event of a phase; that it has begun where that is all that is known."""
    known = data["of"] and data["per_s"] and data["eta_s"] is not None
    return rate_text(data, data["counted"]) if known else "begun"


def trials(data: Mapping[str, Any], what: str = "trials") -> str:
    """n/N, trials/min, the time left if known, and the running one, of a `progress` event of many trials or scans."""
    parts = [f"{data['n']}/{data['of']}"]
    if data["eta_s"] is not None:
        parts += [f"{data['per_min']:.1f} {what}/min", f"{_clock_time(data['eta_s'])} left"]
    return "  ".join([*parts, str(data["label"])])


def fit(data: Mapping[str, Any]) -> str:
    """n/N, rate, views, Gaussians (iterations have none), residuals and time left, of a `progress` event of a fit."""
    step, steps = data["step"], data["steps"]
    word = data.get("unit") or ("steps" if data["n_gaussians"] else "iterations")
    parts = [f"{step}/{steps} {word}"] if steps else [f"{step} {word}"] if data.get("unit") else []
    parts += [f"{data['per_s']:.3g} {word.split()[0]}/s"] if data.get("per_s") else []
    parts += [f"{data['n_views']} views"]
    parts += [f"{data['n_gaussians']} Gaussians"] if data["n_gaussians"] else []
    if data["residual"] is not None and math.isfinite(data["residual"]):
        parts.append(f"residual {data['residual']:.4f}")
    unseen = data.get("held_out")  # another process's NaN comes as None
    if unseen is not None and math.isfinite(unseen):
        parts.append(f"held out {unseen:.4f}")
    if data.get("eta_s") is not None:
        parts.append(f"{_clock_time(data['eta_s'])} left")
    return ", ".join(parts)


def counting(stage: str, sink: Sink, clock: Clock) -> Callable[[int, int], None]:
    """A listener that says how far a stage of the work is, a few times a second."""
    began, said = clock.now(), -math.inf

    def listen(n: int, total: int) -> None:
        nonlocal said
        now = clock.now()
        if now - said < SAY_EVERY and n < total:
            return
        said = now
        rate = n / max(now - began, 1e-9)
        sink(Event("progress", now, {"stage": stage, "n": n, "of": total, "per_s": rate, "eta_s": (total - n) / rate}))

    return listen


def results(data: Mapping[str, Any]) -> str:
    """The result of a reconstruction, from its `done` event: files, grid, then a table of metrics by method."""
    lines = [f"{'output':<10}{data['output']}"]
    lines += [f"{'report':<10}{data['report']}"] if data.get("report") else []
    lines.append(f"{'volume':<10}{' x '.join(str(n) for n in data['shape'])} in {data['units']}")
    lines.append(f"{'axis_col':<10}{data['axis_col']:.2f}")
    for name, key in (("chosen", "chosen"), ("next dB", "next_db_said")):
        if key in data:
            lines.append(f"{name:<10}{data[key]}")
    columns = {str(data["method"]): data}
    if BASELINE in data:
        columns[BASELINE] = data[BASELINE]
    lines.append("")
    lines.append(f"{'':<30}" + "".join(f"{name:>14}" for name in columns))
    for name, metric in METRICS.items():
        if any(name in values for values in columns.values()):
            cells = (formatted(name, values[name]) if name in values else "-" for values in columns.values())
            label = metric.label
            if name == "seconds" and "resumed_from" in data:
                label += ", since resumed"
            lines.append(f"{label:<30}" + "".join(f"{cell:>14}" for cell in cells))
    return "\n".join(lines)


def _clock_time(seconds: float) -> str:
    left = round(seconds)
    return f"{left // 3600}:{left // 60 % 60:02}:{left % 60:02}"
