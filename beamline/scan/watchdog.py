"""Watchdog: a process that makes the instrument safe when the process of the scan dies without doing so (kill -9).

`python -m beamline.scan.watchdog RUN` waits for the end of its stdin, which the scan holds open as long as it lives; a
scan that ends by itself kills the watchdog first. What the scan held is free then: the stage's port, which the watchdog
opens, and the camera, which stops without its program.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from beamline.config.devices import StageOutputShutter
from beamline.config.load import Config, load
from beamline.core.events import Emit
from beamline.core.process import ChildProcess
from beamline.instrument.connect import shutter_of
from beamline.scan.run_folder import CONFIG, WATCHDOG_LOG
from drivers.clock import Clock, SystemClock

PATIENCE = 60.0  # s for each step; a stage refuses to be opened while it slows down
BETWEEN = 0.5  # s between attempts
READY_WITHIN = 60.0  # real s


@contextmanager
def watched(folder: Path, emit: Emit) -> Iterator[None]:
    """A watchdog for the run in this folder as long as the context lasts; a warning where there is none."""
    command, ready = [sys.executable, "-m", "beamline.scan.watchdog", str(folder)], threading.Event()
    with (
        Path(os.devnull).open("w") as nowhere,
        ChildProcess(command, nowhere, lambda line: ready.set(), tether=True) as process,
    ):
        deadline = time.monotonic() + READY_WITHIN
        while not ready.wait(BETWEEN) and process.running and time.monotonic() < deadline:
            pass
        if not ready.is_set() or not process.running:
            emit("warning", {"message": "The watchdog does not run: a scan that is killed leaves the shutter open."})
        yield


def make_safe(config: Config, clock: Clock, say: Callable[[str], None]) -> bool:
    """Stop the stage, then disarm its trigger output and close the shutter; True: all obeyed.

    Args:
        say: takes a sentence on each step.
    """
    stage, shutter = config.devices.stage, config.devices.shutter
    settings, port = stage.settings, stage.port
    closed = "its shutter is closed" if isinstance(shutter, StageOutputShutter) else "the shutter is moved by hand"

    def disarm() -> None:
        with closing(settings.connect(port, clock)) as connected:
            connected.disarm()
            shutter_of(config, connected, clock, say).close()

    stopped = _insist(lambda: settings.halt(port, clock), clock, say, "The stage was told to stop.")
    return _insist(disarm, clock, say, f"The stage stands, its trigger output is disarmed, {closed}.") and stopped


def _insist(step: Callable[[], None], clock: Clock, say: Callable[[str], None], done: str) -> bool:
    """Try until it works or PATIENCE is over; whether it worked."""
    deadline = clock.now() + PATIENCE
    while True:
        try:
            step()
        except Exception as error:  # whatever it is, the next step must be tried
            if clock.now() > deadline:
                say(f"{error} LOOK AT THE INSTRUMENT before anybody goes near the beam.")
                return False
            clock.sleep(BETWEEN)
        else:
            say(done)
            return True


def main(folder: Path) -> None:
    """Wait until the scan is dead, then act, and write down what was done."""
    config = load(folder / CONFIG, environment={})
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    sys.stdin.read()

    def say(text: str) -> None:
        # A full disk, or a folder that is gone, must not keep the stage turning.
        with suppress(OSError), (folder / WATCHDOG_LOG).open("a", encoding="utf-8") as log:
            log.write(f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}  {text}\n")

    say("The process of the scan has died.")
    make_safe(config, SystemClock(), say)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
