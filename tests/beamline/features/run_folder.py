"""A run folder with a small scan, for tests of programs that watch runs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from beamline.core.files import CONFIG
from beamline.core.stop import PauseRequest, StopRequest
from beamline.scan.control import commands_taken
from beamline.storage.run_record import RecordFile, RunRecord
from tests.beamline.scans import TwoCylinders, frames_of, write_flagged

STARTED = {"event": "run_started", "time": 1.7e9, "folder": "a", "path": "a/scan.h5", "sample": "s", "n_frames": 98}
FAILED = (
    STARTED,
    {"event": "flag", "time": 1.7e9 + 1.25, "check": "beam", "level": "alarm", "frame": 3, "advice": "look"},
    {"event": "state", "time": 1.7e9 + 2.5, "state": "failed", "message": "the stage does not answer"},
)
"""Events of a run of 98 frames that ended with an alarm and a failure."""


def write_run(run: Path, *events: dict[str, Any]) -> Path:
    """Write 49 frames of the run, and these events."""
    run.mkdir(exist_ok=True)
    write_flagged(run / "scan.h5", frames_of(TwoCylinders()), {})
    lines = "".join(f"{json.dumps(event)}\n" for event in events)
    (run / "events.jsonl").write_text(lines, encoding="utf-8")
    return run


@contextmanager
def asking(run: Path) -> Iterator[list[str]]:
    """A run whose scan asks what to do next until it is answered; yields the answers so far."""
    answers: list[str] = []
    (run / CONFIG).touch()
    with closing(RecordFile(run, RunRecord("asking"))) as record:

        def take(choice: str) -> None:
            record.put(RunRecord("acquiring"), at_once=True)
            answers.append(str(choice))

        with commands_taken(run, StopRequest(), PauseRequest(), take):
            yield answers
