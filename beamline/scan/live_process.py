"""Live reconstruction: a process of its own that follows the growing file, so that its failure cannot harm the scan."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from beamline.config.load import Config
from beamline.core.events import Emit
from beamline.core.process import ChildProcess, Ending, json_object

LiveCommand = Callable[[Path, Path], Sequence[str]]
"""(scan file, output file) -> the command line."""

_SILENCE = 300.0  # real s without output, after which the process is ended
_GRACE = 30.0  # real s in which it may still write the volume that it has


def follow_command(config: Config) -> LiveCommand:
    """The command `beamline recon SCAN --follow` with the options of the configuration."""
    recon, axis = config.recon, config.recon.axis
    if axis == "auto" and config.optics.axis_col is not None:
        axis = config.optics.axis_col

    def command(scan: Path, output: Path) -> Sequence[str]:
        options = {"--axis": axis, "--seconds": recon.seconds, "--seed": recon.seed, "-o": output}
        words = [word for name, value in options.items() for word in (name, str(value))]
        return [sys.executable, "-m", "beamline.cli.main", "recon", str(scan), "--follow", "--json", *words]

    return command


class LiveReconstruction:
    """A running reconstruction whose events are passed on, each marked with source="recon".

    Its `done` becomes `recon_done` and its `failed` a warning: `done` and `failed` belong to the scan. Its stderr goes
    to the file `log`. A process that cannot be started is a warning, too.
    """

    def __init__(self, command: Sequence[str], log: Path, emit: Emit) -> None:
        self._emit, self._log = emit, log
        self._done: Mapping[str, Any] | None = None
        self._process: ChildProcess | None = None
        try:
            with log.open("x", encoding="utf-8") as stderr:
                self._process = ChildProcess(command, stderr, self._pass_on)
        except OSError as error:
            message = f"The live reconstruction could not be started ({error}). The scan goes on without it."
            emit("warning", {"message": message})

    def finish(self, stop: Callable[[], bool], hurry: Callable[[], bool]) -> Mapping[str, Any] | None:
        """Wait until it ends; the data of its `done` event, or None where it failed.

        Args:
            stop: polled a few times a second; True asks it to end with the volume that it has.
            hurry: polled likewise; True kills it.
        """
        process = self._process
        if process is None:
            return None
        ending = process.wait(stop=stop, hurry=hurry, silence=_SILENCE, grace=_GRACE)
        if self._done is None:
            reasons = {
                Ending.STOPPED: "it was stopped",
                Ending.SILENT: f"it was stopped after {_SILENCE:.0f} s without output",
            }
            reason = reasons.get(ending, f"it ended with code {process.code}")
            message = (
                f"The live reconstruction gave no volume: {reason}; see {self._log.name}. The scan is not affected."
            )
            self._emit("warning", {"message": message, "source": "recon"})
        return self._done

    def close(self) -> None:
        """End it if it still runs."""
        if self._process is not None:
            self._process.end(_GRACE / 6)

    def _pass_on(self, line: str) -> None:
        data = json_object(line)
        if data is None or "event" not in data:
            return
        event = str(data.pop("event"))
        data.pop("time", None)
        if event == "done":
            self._done, event = data, "recon_done"
        elif event == "failed":
            event, data["message"] = "warning", f"Live reconstruction: {data.get('message', 'failed')}"
        self._emit(event, {**data, "source": "recon"})
