"""Watchdog: a process that stops the stage and closes the shutter if the process of the scan is killed or freezes.

`python -m beamline.scan.watchdog RUN PID` reads its stdin. The scan holds this pipe open as long as it lives, and
writes a byte to it every BEAT seconds. The watchdog acts if the pipe closes (kill -9), or if no byte comes for FROZEN s
(SIGSTOP, a hung disk). It prints a line when it is ready. If a watchdog ends, the scan starts another one. A frozen
scan keeps the port of the stage open, so the watchdog first kills the process of the scan. Then the port is free, and
the watchdog opens it. The camera stops when its program ends. A scan that ends normally kills the watchdog first. As
long as the scan lives, the watchdog ignores the termination signals that a shutdown sends to every process.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from datetime import UTC, datetime
from functools import partial
from io import BytesIO, RawIOBase
from pathlib import Path

import psutil

from beamline.config.beam import FoundMonochromator, FoundShutter, MotorSection
from beamline.config.devices import Simple
from beamline.config.load import Config, load
from beamline.core.events import Sink, Warned
from beamline.core.files import CONFIG, WATCHDOG_LOG
from beamline.core.process import ChildProcess
from beamline.core.stop import PauseRequest, StopRequest
from beamline.instrument.connect import shutter_of
from drivers.base.clock import Clock, SystemClock
from drivers.stages.shared import FOUND

PATIENCE = 60.0  # s for each step, because a stage cannot be opened while it slows down
BETWEEN = 0.5  # s between attempts
READY_WITHIN = 60.0  # real s
# real time in s between signs of life; after a watchdog has died, about this time passes until another one runs
BEAT = 0.2
FROZEN = 60.0  # s without a sign of life after which a scan counts as dead
AGAIN = 3  # largest number of watchdogs that are started as replacements
ACTED = 70  # exit code of a watchdog that has made the instrument safe
STDOUT = 1  # written without a buffer, which could not be flushed at the end of the process
COMMAND = (sys.executable, "-m", "beamline.scan.watchdog")
INHIBIT = ("systemd-inhibit", "--what=shutdown:sleep", "--mode=block", "--who=beamline", "--why=A scan runs", "cat")


@contextmanager
def watched(
    folder: Path, sink: Sink, stop: StopRequest | None = None, pause: PauseRequest | None = None
) -> Iterator[None]:
    """A context in which a watchdog process guards the run in this folder. If the watchdog cannot be started, there is
    a warning.

    If the watchdog ends before the scan, this is reported and another watchdog is started.

    Args:
        stop: request that is set to abort if a watchdog assumed that the scan is dead, and acted. pause: request with
            which the scan is paused after the last watchdog has ended; None: the scan continues without a watchdog.
    """
    with Path(os.devnull).open("w") as devnull, inhibited():
        keeper = _Keeper(folder, sink, lambda command, ready: ChildProcess(command, devnull, ready, tether=True))
        with closing(keeper):
            keeper.begin(stop or StopRequest(), pause)
            yield


@contextmanager
def inhibited() -> Iterator[None]:
    """Ask systemd (if the system has it) to prevent shutdown and sleep. The function does not wait for an answer."""
    with ExitStack() as ending:
        if (program := shutil.which(INHIBIT[0])) is not None:
            with suppress(OSError):
                devnull = ending.enter_context(Path(os.devnull).open("w"))
                command = [program, *INHIBIT[1:]]
                process = ending.enter_context(ChildProcess(command, devnull, lambda line: None, tether=True))
                ending.callback(process.let_go)
        yield


class _Keeper:
    """Sends a watchdog signs of life of the scan, from a separate thread, and replaces a watchdog that has died.

    `start`: function that starts a command. A second function is called with each line that the command writes."""

    def __init__(
        self, folder: Path, sink: Sink, start: Callable[[list[str], Callable[[str], None]], ChildProcess]
    ) -> None:
        self._command = [*COMMAND, str(folder), str(os.getpid())]
        self._sink, self._start = sink, start
        self._ready, self._over = threading.Event(), threading.Event()
        self._process = self._started()
        self._thread: threading.Thread | None = None

    def begin(self, stop: StopRequest, pause: PauseRequest | None) -> None:
        """Wait until the first watchdog is ready. From then on, send it signs of life."""
        deadline = time.monotonic() + READY_WITHIN
        while not self._ready.wait(BETWEEN) and self._process.running and time.monotonic() < deadline:
            self._process.tell()
        if not self._ready.is_set() or not self._process.running:
            self._sink(Warned("The watchdog is not running: if the scan is killed, the shutter stays open."))
        self._thread = threading.Thread(target=self._keep, args=(stop, pause), name="watchdog", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._over.set()
        if self._thread is not None:
            self._thread.join(READY_WITHIN)
        self._process.end()

    def _keep(self, stop: StopRequest, pause: PauseRequest | None) -> None:
        restarts_left = AGAIN
        while not self._over.wait(BEAT):
            if self._process.running:
                self._process.tell()
                continue
            code = self._process.code
            if code == ACTED:
                reason = (
                    f"the process did nothing for {FROZEN:.0f} s, so the watchdog stopped the stage and "
                    "closed the shutter"
                )
                self._sink(Warned(f"Failed: {reason}. The scan ends."))
                stop.abort(reason)
                return
            self._process.end()
            if not restarts_left:
                self._sink(
                    Warned(
                        f"The last watchdog has ended, too (code {code}): if the scan is killed now, the shutter "
                        "stays open."
                    )
                )
                if pause is not None:
                    pause.pause("no watchdog is running")
                return
            restarts_left -= 1
            with suppress(OSError):
                self._process = self._started()
            self._sink(Warned(f"The watchdog ended (code {code}); another one is started."))

    def _started(self) -> ChildProcess:
        return self._start(self._command, lambda line: self._ready.set())


def make_safe(config: Config, clock: Clock, say: Callable[[str], None]) -> bool:
    """Stop the stage, disarm its trigger output and close the shutter. Returns True if all steps succeeded. `say` gets
    a sentence on each step.
    """
    stage, shutter = config.devices.stage, config.devices.shutter
    separate_shutter = shutter if isinstance(shutter, FoundShutter) else None
    closed = "the shutter is moved by hand"
    if not isinstance(shutter, Simple):
        closed = "its shutter is closed" if separate_shutter is None else "the shutter is closed in a separate step"

    def disarm() -> None:
        with closing(stage.connect(clock)) as connected:
            if found_settings := connected.describe().get(FOUND):
                say(f"{connected.name}: {found_settings}.")
            connected.disarm()
            if separate_shutter is None:
                shutter_of(config, connected, clock, say).close()
            deadline = clock.now() + PATIENCE  # a stage that slows down does not accept its original settings
            while connected.moving() and clock.now() < deadline:
                clock.sleep(BETWEEN)

    succeeded = [_try_until_done(lambda: stage.halt(clock), clock, say, "The stage was told to stop.")]
    if separate_shutter:
        succeeded.append(
            _try_until_done(lambda: separate_shutter.connect(clock).close(), clock, say, "The shutter is closed.")
        )
    for name, device in (("sample mover", config.devices.sample_mover), ("filter", config.devices.filter)):
        if isinstance(device, MotorSection):
            halt = partial(device.stage.halt, clock)
            succeeded.append(_try_until_done(halt, clock, say, f"The {name} was told to stop."))
    monochromator = config.devices.monochromator
    if isinstance(monochromator, FoundMonochromator) and monochromator.stops:
        succeeded.append(
            _try_until_done(partial(monochromator.halt, clock), clock, say, "The monochromator was told to stop.")
        )
    succeeded.append(
        _try_until_done(disarm, clock, say, f"The stage is stopped, its trigger output is disarmed, {closed}.")
    )
    return all(succeeded)


def _try_until_done(step: Callable[[], None], clock: Clock, say: Callable[[str], None], sentence: str) -> bool:
    """Try the step until it works or PATIENCE is over. Returns True if it worked."""
    deadline = clock.now() + PATIENCE
    while True:
        try:
            step()
        except BaseException as error:  # after any error (even SystemExit from a plug-in) the next step must be tried
            if clock.now() > deadline:
                say(f"DANGER: {error} Check the instrument before anybody goes near the beam.")
                return False
            clock.sleep(BETWEEN)
        else:
            say(sentence)
            return True


class _SignsOfLife:
    """Counts the signs of life from a stream, in a separate thread, because reading a pipe blocks."""

    def __init__(self, source: RawIOBase | BytesIO) -> None:
        self._source, self.signs, self.ended = source, 0, False
        threading.Thread(target=self._read, name="signs of life", daemon=True).start()

    def _read(self) -> None:
        with suppress(OSError, ValueError):
            while data := self._source.read(1):
                self.signs += len(data)
        self.ended = True


def until_dead(signs: Callable[[], int | None], clock: Clock) -> bool:
    """Wait until the scan process is dead or hangs. Returns True if it hangs.

    If this process itself was inactive during a step (because the computer slept or was swapping memory), the whole
    time counts as one step.

    Args:
        signs: function that returns the number of signs of life so far; None: the process has ended.
    """
    silent_seconds, last_time = 0.0, clock.now()
    last_count = signs()
    while last_count is not None:
        clock.sleep(BETWEEN)
        silent_seconds, last_time = silent_seconds + min(clock.now() - last_time, 2 * BETWEEN), clock.now()
        if (count := signs()) != last_count:
            silent_seconds, last_count = 0.0, count
        elif silent_seconds >= FROZEN:
            return True
    return False


def main(folder: Path, scan: int, source: RawIOBase | BytesIO) -> int:
    """Wait until the scan process is dead. Then make the devices safe, and log this. Returns the exit code.

    Args:
        scan: process of the scan. source: stream that ends when the process dies.
    """
    for name in ("SIGTERM", "SIGINT", "SIGHUP", "SIGBREAK"):
        if (request := getattr(signal, name, None)) is not None:
            signal.signal(request, signal.SIG_IGN)
    config = load(folder / CONFIG, environment={})
    life, clock = _SignsOfLife(source), SystemClock()

    with suppress(OSError):  # the scan has died, perhaps before this process was started
        os.write(STDOUT, b"watching\n")
    frozen = until_dead(lambda: None if life.ended else life.signs, clock)

    def say(text: str) -> None:
        # Even if the disk is full or the folder was removed, the stage must be stopped.
        with suppress(OSError), (folder / WATCHDOG_LOG).open("a", encoding="utf-8") as log:
            log.write(f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}  {text}\n")

    if frozen:
        say(
            f"The process of the scan did nothing for {FROZEN:.0f} s, so it is assumed to hang. The watchdog kills "
            "the process, because only then the watchdog can open the ports of the devices."
        )
        try:
            psutil.Process(scan).kill()  # the number still belongs to the process of the scan, because the pipe is open
        except psutil.Error as error:
            say(f"It could not be killed: {error}.")
    else:
        say("The process of the scan was killed.")
    make_safe(config, clock, say)
    return ACTED


if __name__ == "__main__":
    # Written without a buffer, because a reading thread would hold the lock of the buffer at the end of the process.
    with open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as signs_of_life:
        sys.exit(main(Path(sys.argv[1]), int(sys.argv[2]), signs_of_life))
