"""Live reconstruction: a process of its own that follows the growing file, so that its death costs the scan nothing."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from beamline.config.load import Config
from beamline.core.events import Emit

LiveCommand = Callable[[Path, Path], Sequence[str]]
"""(scan file, output file) -> the command line."""

LOOK = 0.2  # real s between looks at whether it should still go on
PATIENCE = 300.0  # real s without a word, after which it is given up
GRACE = 30.0  # real s in which it may still deliver the volume as it is


def follow_command(config: Config) -> LiveCommand:
    """`beamline recon SCAN --follow`, as the configuration wants it."""
    recon, axis = config.recon, config.recon.axis
    if axis == "auto" and config.optics.axis_col is not None:
        axis = config.optics.axis_col

    def command(scan: Path, output: Path) -> Sequence[str]:
        options = {"--axis": axis, "--seconds": recon.seconds, "--seed": recon.seed, "-o": output}
        words = [word for name, value in options.items() for word in (name, str(value))]
        return [sys.executable, "-m", "beamline.cli.main", "recon", str(scan), "--follow", "--json", *words]

    return command


class LiveReconstruction:
    """A running process whose event lines are passed on, each marked with source="recon".

    Its `done` becomes `recon_done` and its `failed` a warning: the run's own last word stays its own. What it writes
    to stderr goes to `log`. A process that cannot even be started is a warning too.
    """

    def __init__(self, command: Sequence[str], log: Path, emit: Emit) -> None:
        self._emit, self._log = emit, log
        self._done: Mapping[str, Any] | None = None
        self._last_word = threading.Event()
        self._process: subprocess.Popen[str] | None = None
        self._reader = threading.Thread(target=self._read, name="live reconstruction", daemon=True)
        try:
            with log.open("x", encoding="utf-8") as stderr:
                # A group of its own: Ctrl-C at the terminal is for the scan, which decides what becomes of this.
                self._process = subprocess.Popen(
                    list(command),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=stderr,
                    text=True,
                    encoding="utf-8",
                    errors="replace",
                    start_new_session=True,
                    creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
                )
        except OSError as error:
            emit("warning", {"message": f"live reconstruction cannot be started ({error}); the scan goes on without"})
            return
        self._reader.start()

    def finish(self, give_up: Callable[[], bool], hurry: Callable[[], bool]) -> Mapping[str, Any] | None:
        """Wait for its end; the data of its `done` event, or None where it failed.

        Args:
            give_up: asked a few times a second; True asks it to end with what it has.
            hurry: likewise; True ends it without.
        """
        process = self._process
        if process is None:
            return None
        silent, given_up = 0.0, ""
        while process.poll() is None:
            try:
                process.wait(LOOK)
            except subprocess.TimeoutExpired:
                silent = 0.0 if self._last_word.is_set() else silent + LOOK
                self._last_word.clear()
                if give_up() or silent > PATIENCE:
                    given_up = "it was ended" if give_up() else f"it said nothing for {PATIENCE:.0f} s"
                    self._end(process, GRACE, hurry)
        self._reader.join()
        if self._done is None:
            why = given_up or f"it ended with code {process.returncode}"
            message = f"live reconstruction made no volume: {why} ({self._log.name} has its words). The scan is unhurt."
            self._emit("warning", {"message": message, "source": "recon"})
            return None
        return self._done

    def close(self) -> None:
        """End it where it still runs."""
        if self._process is not None and self._process.poll() is None:
            self._end(self._process, GRACE / 6, lambda: False)
            self._reader.join()

    def _end(self, process: subprocess.Popen[str], grace: float, hurry: Callable[[], bool]) -> None:
        process.terminate()
        while grace > 0 and not hurry():
            grace -= LOOK
            with suppress(subprocess.TimeoutExpired):
                process.wait(LOOK)
                return
        process.kill()
        process.wait()

    def _read(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                self._last_word.set()
                self._pass_on(line)

    def _pass_on(self, line: str) -> None:
        try:
            data = dict(json.loads(line))
            event = str(data.pop("event"))
        except (ValueError, TypeError, KeyError):
            return  # not an event: a library's print, say
        data.pop("time", None)
        if event == "done":
            self._done, event = data, "recon_done"
        elif event == "failed":
            event, data["message"] = "warning", f"live reconstruction: {data.get('message', 'failed')}"
        self._emit(event, {**data, "source": "recon"})
