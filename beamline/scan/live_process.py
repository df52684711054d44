"""Live reconstruction: starts a separate process that follows the growing file, so that its failure cannot harm the
scan.
"""

from __future__ import annotations

import json
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TextIO

from beamline.config.load import Config
from beamline.config.planned import plan_of
from beamline.core.event_lines import event_of
from beamline.core.events import Done, Failed, Sink, StateEntered, Warned
from beamline.core.machine import free_memory
from beamline.core.process import ChildProcess, ProcessEnd, json_object
from beamline.core.recon_events import ALL_SHOWN, LawMeasured, ReconDone
from beamline.core.stop import StopRequest
from beamline.instrument.connect import describe
from beamline.scan.live_plan import LivePlan, live_plan
from recon.methods import streams

if TYPE_CHECKING:
    from beamline.scan.resume import ResumableRun

# function of scan file and output file that returns the command line
LiveCommand = Callable[[Path, Path], Sequence[str]]

_SILENCE = 300.0  # real time in s without output after which the process is ended
_GRACE = 120.0  # real time in s for which it may still write its volume, unless the operator aborts
_CLOSE = 5.0  # the same if the scan itself has failed
_AGAIN = 2  # how often it is started again
_SHOWN_WITHIN = 5.0  # real s after the scan
_POLL = 0.1  # real s between two checks of its readiness
_SAY_EVERY = 5.0  # real s between two sentences on a volume that is waited for after a stop
ASK_LIVE_AFTER = 4.0
"""Real time in s from the request to stop a scan to the request for the volume of the live reconstruction. With this
time, the volume comes within 10 s. The time that the scan takes to end is included."""


def follow_command(config: Config, plan: LivePlan | None = None, earlier: Sequence[Path] = ()) -> LiveCommand:
    """The command `beamline recon SCAN --follow` with the options of the configuration.

    Args:
        earlier: earlier files of the same scan. Their projections come first.
    """
    plan = plan or LivePlan()
    options = _common(config)
    if config.recon.reference is None:
        options["--seconds"] = config.recon.seconds
    if plan.binning > 1:
        options["--bin"] = plan.binning
    if plan.one_in > 1:
        options["--views"] = f"every:{plan.one_in}"
    flags = ["--follow", *(word for part in earlier for word in ("--previous-part", str(part)))]
    return lambda scan, output: _recon_command(scan, flags, {**options, "-o": output})


def finished_command(config: Config) -> LiveCommand:
    """The command `beamline recon SCAN` for the complete scan, for a method that needs all projections."""
    return lambda scan, output: _recon_command(scan, [], {**_common(config), "-o": output})


@dataclass(frozen=True)
class Commands:
    """The commands that reconstruct a scan while it runs, or when it is complete. If both are None, there is no
    reconstruction.

    Attributes:
        live: command that runs during the scan. It makes the volume, unless it only `draws` pictures and ends with the
            scan.
        remark: a remark for the operator; "" if there is none.
    """

    live: LiveCommand | None = None
    afterwards: LiveCommand | None = None
    remark: str = ""
    draws: bool = False


def commands_of(config: Config, series: ResumableRun | None = None) -> Commands:
    """The commands for the configuration of a scan, or of a resumed run."""
    method, draws = config.recon.chosen_method, config.recon.reference is not None
    if not config.recon.live:
        return Commands()
    if draws and (series is None or series.end_references is None):
        commands = Commands(_followed(config, series), finished_command(config), draws=True)
        return replace(commands, remark="Pictures are drawn during the scan; the volume is made after the scan.")
    if not streams(method):
        remark = f"{method} needs the complete scan, so the reconstruction starts after the scan."
        return Commands(afterwards=finished_command(config), remark=remark)
    if series is not None and series.end_references is not None:
        remark = "No live volume is made, because only darks and flats are taken now: reconstruct joined.h5 afterwards."
        return Commands(afterwards=finished_command(config), remark=remark)
    return Commands(live=_followed(config, series))


def _followed(config: Config, series: ResumableRun | None) -> LiveCommand:
    _, camera, _ = describe(config)
    plan = live_plan(camera.shape, plan_of(config).n_views, free_memory())
    return follow_command(config, plan, series.parts if series else ())


def _common(config: Config) -> dict[str, object]:
    recon, axis = config.recon, config.recon.axis
    if axis == "auto" and config.optics.axis_col is not None:
        axis = config.optics.axis_col
    of_reference = {} if recon.reference is None else {"--reference": recon.reference}
    return {"--method": recon.chosen_method, "--axis": axis, "--seed": recon.seed, **of_reference}


def _recon_command(scan: Path, flags: Sequence[str], options: Mapping[str, object]) -> Sequence[str]:
    option_words = [word for name, value in options.items() for word in (name, str(value))]
    return [
        sys.executable,
        "-m",
        "beamline.cli.main",
        "recon",
        str(scan),
        *flags,
        "--beside-scan",
        "--json",
        *option_words,
    ]


def live_should_end(stop: StopRequest, useless: bool) -> Callable[[], bool]:
    """True if the live reconstruction of an ended scan should end with its present volume.

    It should end after a new stop, ASK_LIVE_AFTER after the stop of the scan, or if the file is `useless`: damaged or
    without projections.
    """
    earliest = ASK_LIVE_AFTER if stop.stopping else 0.0
    return lambda: useless or (stop.stopping and stop.seconds >= earliest)


def abort_watch(stop: StopRequest, say: Callable[[str], None]) -> Callable[[], bool]:
    """A function that is called during the wait for the live volume after a scan. It returns True if the scan was
    aborted; then the live reconstruction is killed.

    For a stopped scan, the function reports the duration of the wait, at its first call and then every 5 s.
    """
    # waiting time for the volume, see `live_should_end`
    requested_after = max(stop.seconds, ASK_LIVE_AFTER) if stop.stopping else 0.0
    due, longest_wait = 0.0, requested_after + _GRACE

    def aborting() -> bool:
        nonlocal due
        if stop.stopping and not stop.aborting and stop.seconds >= due:
            due = stop.seconds + _SAY_EVERY
            waited = f"{stop.seconds:.0f} of at most {longest_wait:.0f} s"
            say(
                f"Waiting for the live volume from the projections taken so far ({waited}). Press Ctrl-C to finish "
                "without a live volume"
            )
        return stop.aborting

    return aborting


class LiveReconstruction:
    """A running reconstruction whose events are passed on, each marked with source="recon".

    Its event `done` becomes `recon_done`, and its event `failed` becomes a warning, because `done` and `failed` belong
    to the scan. Its stderr goes to the file `log`. If the process cannot be started, there is only a warning. The
    process ends when this process ends, even if this process is killed; it then leaves no volume. If a signal kills it
    during the scan, it is started again, at most twice. No data are lost, because the file has all projections, and the
    final fit makes up for the lost steps.

    Args:
        on_law: function that gets each measured error model, in the thread that reads the output.
        what: name of the reconstruction in messages. silence: time in s without output after which `finish` stops the
            process. low_priority: True if a scan on the same computer takes precedence. child: function that starts the
            process, such as `Standby.start`.

    Attributes:
        ended: True if no error model will come, because the process could not be started, or ended during the scan and
            is not started again.
    """

    def __init__(
        self,
        command: Sequence[str],
        log: Path,
        sink: Sink,
        on_law: Callable[[LawMeasured], None] = lambda error_law: None,
        what: str = "live reconstruction",
        silence: float = _SILENCE,
        low_priority: bool = True,
        child: Callable[..., ChildProcess] = ChildProcess,
    ) -> None:
        self._sink, self._log, self._on_law, self._what = sink, log, on_law, what
        self._silence, self.ended = silence, False
        self._done: Mapping[str, Any] | None = None
        self._wanted = True  # no other code has asked it to end
        self._ready, self._shown = threading.Event(), threading.Event()
        self._process: ChildProcess | None = None
        self._command, self._low_priority, self._restarts_left, self._child = command, low_priority, _AGAIN, child
        self._changing = threading.Lock()  # protects the process, and the request for another one
        with self._changing:
            self._start("a" if self._log.exists() else "x")

    def _start(self, mode: Literal["a", "x"]) -> None:
        try:
            with self._log.open(mode, encoding="utf-8") as stderr:
                self._process = self._child(
                    self._command, stderr, self._pass_on, tether=True, on_end=self._on_end, behind=self._low_priority
                )
        except OSError as error:
            self.ended = True
            self._sink(Warned(f"The {self._what} could not be started ({error}). The scan is not affected."))

    def wait_ready(self, seconds: float, stop: Callable[[], bool], say: Callable[[str], None]) -> None:
        """Wait until the reconstruction has compiled its kernels or ended, `stop` returns True, or the timeout (s of
        real time) has passed; `say` gets a sentence on what the scan waits for.

        After a timeout, there is only a warning, because the scan can start without the reconstruction.
        """
        deadline = time.monotonic() + seconds
        if not self._ready.is_set():
            say(
                "Waiting until the live reconstruction has compiled its kernels (1 to 2 minutes the first time on a "
                f"computer, later a few seconds; at most {seconds:.0f} s). A pause starts after this wait; a stop "
                "ends the wait"
            )
        while self._process is not None and self._process.running and not stop():
            if self._ready.wait(_POLL):
                return
            if time.monotonic() >= deadline:
                message = (
                    f"The scan starts now. The live reconstruction is still loading after {seconds:.0f} s "
                    "and will catch up later."
                )
                self._sink(Warned(message))
                return

    def finish(self, stop: Callable[[], bool], hurry: Callable[[], bool]) -> Mapping[str, Any] | None:
        """Wait until the reconstruction ends. Returns the data of its event `done`, or None if it failed.

        Args:
            stop: function that is called a few times a second; if it returns True, the reconstruction is asked to end
                with its present volume. hurry: function that is called in the same way, also while the reconstruction
                ends; if it returns True, the process is killed. It may also report the duration of the wait.
        """
        with self._changing:
            process, self._wanted = self._process, False
        if process is None:
            return None
        ending = process.wait(stop=lambda: hurry() or stop(), hurry=hurry, silence=self._silence, grace=_GRACE)
        if self._done is None:
            reasons = {
                ProcessEnd.STOPPED: "it was stopped",
                ProcessEnd.SILENT: f"the process was stopped after {self._silence:.0f} s without output",
            }
            reason = reasons.get(ending, f"it ended with code {process.code}")
            message = f"The {self._what} gave no volume: {reason}. See {self._log.name}. The scan is not affected."
            self._sink(Warned(message, source="recon"))
        return self._done

    def end_shown(self, stop: Callable[[], bool]) -> None:
        """Kill the process when its picture shows all projections, or after 5 s. `stop` ends the wait."""
        with self._changing:
            process, self._wanted = self._process, False
        deadline = time.monotonic() + _SHOWN_WITHIN
        while process is not None and process.running and not stop() and time.monotonic() < deadline:
            if self._shown.wait(_POLL):
                break
        if process is not None:
            process.end()

    def close(self) -> None:
        """End the process if it is still running."""
        with self._changing:
            process, self._wanted = self._process, False
        if process is not None:
            process.end(_CLOSE)

    def _on_end(self) -> None:
        """Warn at once if the process ends while the scan runs, because otherwise the operator would watch a volume
        that does not grow. If the process was killed, start it again."""
        with self._changing:
            process = self._process
            if not self._wanted or self._done is not None or process is None:
                return
            process.let_go()
            since = time.monotonic()
            while process.code is None and time.monotonic() - since < _CLOSE:  # the output ends before the process does
                time.sleep(_POLL)
            when = "during the scan" if self._ready.is_set() else "before it was ready"
            if killed := process.code is not None and process.code < 0 and self._restarts_left > 0:
                self._restarts_left -= 1
                then = (
                    "A new live reconstruction is started; it begins with the projections that are already in the file."
                )
            else:
                self.ended = True
                then = (
                    "The scan continues without a live reconstruction. To start another live reconstruction: beamline "
                    "recon FILE --follow -o OUT.h5"
                )
            message = f"The live reconstruction ended {when} (code {process.code}). See {self._log.name}. {then}"
            self._sink(Warned(message, source="recon"))
            if killed:
                self._start("a")

    def _pass_on(self, line: str) -> None:
        try:
            event = event_of(json_object(line) or {})
        except ValueError:
            return
        match event:
            case StateEntered(state="ready"):
                self._ready.set()
            case StateEntered(state=state) if state == ALL_SHOWN:
                self._shown.set()
            case LawMeasured():
                self._on_law(event)
            case Done():
                self._done = event.data
                event = ReconDone(self._done)
            case Failed(message=message):
                event = Warned(f"{self._what.capitalize()}: {message}")
        self._sink(replace(event, source="recon"))


class Standby:
    """A process that loads the modules of a live reconstruction before a scan begins, and then runs the reconstruction.
    `close` ends it."""

    def __init__(self) -> None:
        self._process: ChildProcess | None = None

    def prepare(self) -> None:
        """Start a waiting process, unless there already is one. If the start fails, the error is raised when the
        process is used."""
        if self._process is None or not self._process.running:
            with suppress(OSError), Path(os.devnull).open("w") as nowhere:
                self._process = ChildProcess(
                    [sys.executable, "-m", "beamline.cli.standby"], nowhere, lambda line: None, tether=True, behind=True
                )

    def start(
        self, command: Sequence[str], stderr: TextIO, on_line: Callable[[str], None], *, on_end: Callable[[], None],
        tether: bool, behind: bool,
    ) -> ChildProcess:  # fmt: skip
        """Run a command of this program as a `ChildProcess`, in the waiting process if there is one, otherwise in a new
        process."""
        process, self._process = self._process, None
        if process is None or not process.running:
            return ChildProcess(command, stderr, on_line, tether=tether, on_end=on_end, behind=behind)
        process.become(json.dumps([stderr.name, *command[3:]], allow_nan=False), on_line, on_end)
        return process

    def close(self) -> None:
        """End the waiting process."""
        if self._process is not None:
            self._process.end()


def reconstruct(command: Sequence[str], log: Path, sink: Sink, stop: StopRequest) -> Mapping[str, Any] | None:
    """Reconstruct a complete scan in a separate process. Return the values of the event `done`; None if the
    reconstruction failed."""
    process = LiveReconstruction(command, log, sink, what="reconstruction", silence=math.inf, low_priority=False)
    try:
        return process.finish(lambda: stop.stopping, lambda: stop.aborting)
    finally:
        process.close()
