"""Output for people: events as a progress bar or plain lines on stderr; the result of a reconstruction as text."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TextIO

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from beamline.cli.options import json_events
from beamline.core.durations import seconds_left
from beamline.core.events import (
    Counted,
    Done,
    Event,
    Failed,
    FrameStored,
    KernelsCompiled,
    PhaseReached,
    RunDone,
    RunStarted,
    Sink,
    TrialReached,
)
from beamline.core.process import ChildProcess
from beamline.core.recon_events import FitReached, VolumeDone
from beamline.core.sinks import Narration, Warnings, lines
from beamline.core.stop import terminated_like_interrupted
from beamline.core.text import SENTENCE, count, one_line, printable
from beamline.report.metrics import METRICS, formatted
from drivers.base.clock import Clock, SystemClock
from drivers.in_beam import Ask
from recon.base.registry import in_folders
from recon.methods import BASELINE

if TYPE_CHECKING:
    from beamline.storage.recon_record import ReconRecord


SAY_EVERY = 0.2  # s between events on the progress of many frames
# environment variable of processes that a Jupyter kernel starts; the cells of a notebook imitate a terminal
NOTEBOOK = "JPY_PARENT_PID"
PLAIN_EVERY = 5.0  # Real time in s between progress lines on a stream that is not a terminal
_ITERATIONS = {
    "sweeps of trials": "iterations of test reconstructions (to choose the settings)",
    "sweeps on voxels": "iterations of the voxel refinement",
    "sweeps of error bars": "iterations for the error bars",
}  # beginning of the unit of a progress event: its name in the progress line
_COUNTED = dict.fromkeys(("ingest", "xafs", "monitor", "validate"), ("frames", "frames"))
# stage: name of its progress bar, and name of the items. Other stages are named after their items.


class Terminal:
    """A sink that prints events. Leaving it as a context manager removes the progress bar.

    Args:
        stream: where to print (stderr, because stdout is for results). A terminal gets a progress bar, and any other
            stream gets plain lines. A cell of a notebook also gets plain lines, because it would keep each state of a
            bar as a line.
    """

    def __init__(self, stream: TextIO) -> None:
        self._console = Console(
            file=getattr(stream, "unfiltered", stream),
            force_terminal=False if NOTEBOOK in os.environ else None,
            highlight=False,
            markup=False,
            emoji=False,
            soft_wrap=True,
        )
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[note]}", markup=False),
            TimeElapsedColumn(),
            console=self._console,
            transient=True,
            # the streams that rich puts in place would not replace control characters in texts from outside
            redirect_stdout=False,
            redirect_stderr=False,
            disable=not self._console.is_terminal,
        )
        self._tasks: dict[str, TaskID] = {}
        self._printed: dict[str, tuple[float, int]] = {}  # real time (s), and frame or step, of the last line
        self._last_text, self._narrated = "", Narration()
        self._lock = threading.Lock()  # events come from one thread, and questions to the operator from another
        self._asking = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def ask(self, request: str, put: Ask) -> None:
        """Print a request to the operator without the progress bar, and wait until `put` returns."""
        with self._lock:
            self._bar.stop()
            self._asking = True
        try:
            put(request)
        finally:
            self._asking = False

    def __call__(self, event: Event) -> None:
        with self._lock:
            for each in self._narrated(event):
                self._take(each)

    def say(self, text: str) -> None:
        """Print a line that is not an event."""
        with self._lock:
            self._console.print(printable(text))

    def _take(self, event: Event) -> None:
        match event:
            case FrameStored(n, of):
                self._show("scan", n, of, rates(event))
            case Counted(stage, n, of):
                counted_name, counted = _COUNTED.get(stage, (stage, stage))
                self._show(counted_name, n, of, rate_text(event, counted))
            case PhaseReached(_, counted, phase, n, of) if n or not self._bar.disable:
                self._show(phase, n, of, rate_text(event, counted))
            case TrialReached(stage, n, of):
                counted_name = in_folders("beamline.features", "COUNTED").get(stage, "trials")
                self._show(counted_name, n, of, trials(event, counted_name))
            case KernelsCompiled(_, n, seconds):
                self._show(
                    "kernels",
                    n,
                    0,
                    f"{n} kernels compiled in {seconds:.0f} s (only the first time on a computer; takes 1 to 2 "
                    "minutes)",
                )
            case FitReached(_, step, steps):
                self._show("volume", step, steps, fit(event))
            case Failed() | VolumeDone() | RunDone() | Done():
                pass  # the command prints these events itself
            case _:
                text = "\n".join(lines(event))
                if text and text != self._last_text:  # another snapshot with the same projections is not printed again
                    self._last_text = text
                    self._console.print(text)

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
        last, last_done = self._printed.get(what, (-PLAIN_EVERY, -1))
        if done == last_done == total:
            return
        if now - last >= PLAIN_EVERY or done == total:
            self._printed[what] = now, done
            self._console.print(f"{what}: {note}")


@contextmanager
def events_shown(as_json: bool) -> Iterator[Sink]:
    """The sink for the events of a command: JSON on stdout, or text in the terminal. SIGTERM and SIGHUP end the
    block."""
    with terminated_like_interrupted(), json_events(as_json) as json_sink, Terminal(sys.stderr) as terminal:
        yield json_sink if as_json else terminal


class Answer:
    """The output of a command: events during the work, and then the result, as facts for programs or as lines for
    people.

    Attributes:
        sink: receives the events. clock: gives the times of the events. lines: the result as lines for people, when the
            work is done.
    """

    def __init__(self, sink: Sink) -> None:
        self.sink, self.clock = sink, SystemClock()
        self.lines: tuple[str, ...] = ()
        self._begun = self.clock.now()
        self.warn = Warnings(sink, self.clock)

    @property
    def seconds(self) -> float:
        """Seconds since the command began."""
        return self.clock.now() - self._begun

    def counting(self, stage: str) -> Callable[[int, int], None]:
        """See `counting`."""
        return counting(stage, self.sink, self.clock)

    def done(self, facts: object, *lines: str) -> None:
        """Send the event `done` with the facts. When the work has ended, the lines are printed for people."""
        self.sink(Done(facts, time=self.clock.now()))
        self.lines = lines


@contextmanager
def answering(as_json: bool) -> Iterator[Answer]:
    """A context with the output of a command. Its end prints the lines, unless stdout is for JSON."""
    with events_shown(as_json) as sink:
        answer = Answer(sink)
        yield answer
    if answer.lines and not as_json:
        click.echo("\n".join(answer.lines))


def rates(frame: FrameStored) -> str:
    """n/N, frames/s, MB/s and the time left."""
    speed = f"{frame.frames_per_s:.1f} frames/s  {frame.mb_per_s:.1f} MB/s"
    return f"{frame.n}/{frame.of}  {speed}  {timedelta(seconds=round(frame.eta_s))} left"


def rate_text(done: Counted | PhaseReached, what: str = "frames") -> str:
    """n/N with rate and remaining time, if they are known; otherwise `started`."""
    if not (done.of and done.per_s) or done.eta_s is None:
        return "started"
    what = "projections" if what == "views" else what
    return f"{done.n}/{done.of}  {done.per_s:.1f} {what}/s  {timedelta(seconds=round(done.eta_s))} left"


def trials(done: TrialReached, what: str = "trials") -> str:
    """n/N, trials/min, remaining time if known, and the running trial."""
    parts = [f"{done.n}/{done.of}"]
    if done.eta_s is not None:
        parts += [f"{done.per_min:.1f} {what}/min", f"{timedelta(seconds=round(done.eta_s))} left"]
    return "  ".join([*parts, one_line(done.label, SENTENCE)])


def fit(reached: FitReached) -> str:
    """n of N, rate, projections, Gaussians (not for iterations), residuals and remaining time."""
    known = next((name for name in _ITERATIONS if reached.unit.startswith(name)), None)
    word = _ITERATIONS[known] if known else reached.unit or ("steps" if reached.n_gaussians else "iterations")
    about = "about " if "as a rule" in reached.unit else ""
    parts = (
        [f"{reached.step} of {about}{reached.steps} {word}"]
        if reached.steps
        else [f"{reached.step} {word}"]
        if reached.unit
        else []
    )
    parts += [f"{reached.per_s:.3g} {word.split()[0]}/s"] if reached.per_s else []
    parts += [count(reached.n_views, "projection")]
    parts += [f"{reached.n_gaussians} Gaussians"] if reached.n_gaussians else []
    errors = {"residual": reached.residual, "residual of held-out projections": reached.held_out}
    parts += [f"{name} {error:.4f}" for name, error in errors.items() if error is not None and math.isfinite(error)]
    # not shown as the time left for the work, because other parts may follow
    remaining = "left for this step" if reached.unit else "left"
    parts += [] if reached.eta_s is None else [f"{timedelta(seconds=round(reached.eta_s))} {remaining}"]
    return ", ".join(parts)


def counting(stage: str, sink: Sink, clock: Clock) -> Callable[[int, int], None]:
    """A listener that reports the progress of a stage of the work, a few times a second."""
    began, last_line_at = clock.now(), -math.inf

    def progress(n: int, total: int) -> None:
        nonlocal last_line_at
        now = clock.now()
        if now - last_line_at < SAY_EVERY and n < total:
            return
        last_line_at = now
        spent = max(now - began, 1e-9)
        sink(Counted(stage, n, total, n / spent, seconds_left(n, total, spent) or 0.0, time=now))

    return progress


def results(record: ReconRecord) -> str:
    """The result of a reconstruction: files and grid, then a table of metrics by method."""
    shape, seconds = " x ".join(str(n) for n in record.grid.shape), record.seconds_of_volumes
    several = "" if record.series is None else f"{record.series.n} of "
    span = f", {seconds[0]:.4g} to {seconds[-1]:.4g} s" if len(seconds) else ""
    numbers: dict[str, Any] = dict(record.parameters)
    drawn = f" ({record.times['report']:.1f} s)" if record.times.get("report") else ""
    rows = {
        "output": record.output,
        "report": record.report and f"{record.report}{drawn}",
        "volumes" if several else "volume": f"{several}{shape} in {record.unit or 'volume fractions'}{span}",
        "axis": f"column {record.axis_col:.2f}",
        "cone": "magnification" in numbers
        and "magnification {magnification:.4g}, voxels of {voxel_mm:.4g} mm, fan angle {fan_deg:.3g} degrees".format(
            **numbers
        ),
        "chosen": record.chosen,
        "ended": _ended(record.parameters),
    }
    lines = [f"{name:<10}{text}" for name, text in rows.items() if text]
    return "\n".join([*lines, "", *_metrics_of(record)])


def _ended(settings: Mapping[str, Any]) -> str:
    """How the iterations ended, for a method whose iterations end by themselves; empty for other methods."""
    words = {
        "still": "converged: the volume no longer changed after {} iterations",
        "stopped": "stopped after {} iterations, before the volume had converged",
        "bound": "ended after {} iterations, before the volume had converged (a larger --iterations allows more)",
    }
    reason, done = settings.get("ended"), settings.get("ended_after")
    last_change = settings.get("last_change")
    change = (
        ""
        if reason == "still" or last_change is None
        else f"; the last four iterations changed the volume by {last_change:.2%}"
    )
    return words[reason].format(done) + change if reason in words else ""


def _metrics_of(record: ReconRecord) -> list[str]:
    """The lines of a table of metrics, with one column per method."""
    columns = {record.method: {**record.metrics, "elapsed": record.elapsed}}
    if record.compared is not None:
        columns[BASELINE] = {**record.compared}
    lines = [f"{'':<38}" + "".join(f"{name:>14}" for name in columns)]
    for name, metric in METRICS.items():
        if any(name in values for values in columns.values()):
            cells = (formatted(name, values[name]) if name in values else "-" for values in columns.values())
            label = metric.label
            if name == "seconds" and record.ending.resumed_from:
                label += ", since resumed"
            lines.append(f"{label:<38}" + "".join(f"{cell:>14}" for cell in cells))
    return lines


LOOK, ACT = "watch", "control"  # Purpose of an address, which is also the first word of its line
ENDS_WITHIN = 3.0  # s


class PageBeside:
    """A sink that serves the page of a run from a separate process, within the context.

    Args:
        say: function that prints the addresses, one per line. They contain the access tokens, so they must not be
            logged.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._held = say, ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._held.close()

    def __call__(self, event: Event) -> None:
        if isinstance(event, RunStarted):
            self.serve("watch", str(event.folder), "--control")

    def serve(self, *command: str) -> Callable[[bytes], object]:
        """Start the server of a page with its command. Returns a function that writes to the server."""
        words = [sys.executable, "-m", "beamline.cli.main", *command, "--until-stdin-ends"]
        try:
            nowhere = self._held.enter_context(Path(os.devnull).open("w"))  # noqa: SIM115 - the context closes it
            child = ChildProcess(words, nowhere, self._pass_on, tether=True, behind=True)
            self._held.callback(child.wait, seconds=ENDS_WITHIN)
            self._held.callback(child.let_go)  # called first, so that open pages show that the server ends
            return child.tell
        except OSError as error:
            self._say(f"The page cannot be shown ({error}). The scan is not affected.")
            return lambda text: None

    def _pass_on(self, line: str) -> None:
        first_word, _, address = line.strip().partition(" ")
        if first_word in (LOOK, ACT):
            self._say(f"Page to {first_word} the scan: {address.strip()}")
