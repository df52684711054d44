"""Documents follow the events of the scan, and not those of its live reconstruction."""

from pathlib import Path
from typing import Any

import pytest

from beamline.bluesky.documents import Documents
from beamline.core.events import Failed, FrameStored, RunDone, RunStarted, ScanDone
from beamline.core.run_result import RunResult
from tests.beamline.ran import small

pytest.importorskip("event_model")
FLUSH = 16
STARTED = RunStarted(Path("runs/a"), Path("runs/a/scan.h5"), "battery", 60, 1.0, 1, [])
FRAME = FrameStored(20, 60, "projection", 1.0, 1.0, 1.0)


def _result(status: str, n: int) -> RunResult:
    return RunResult(Path("runs/a/scan.h5"), n, [], {}, 0, 0, 0, [], 1.0, 1, None, status)


def _done(status: str, n: int) -> ScanDone:
    return ScanDone(_result(status, n))


def _told(*events: Any) -> list[tuple[str, Any]]:
    told: list[tuple[str, Any]] = []
    documents = Documents(small(), lambda name, document: told.append((name, document)))
    for event in events:
        documents(event)
    return told


def test_a_datum_names_only_rows_that_are_flushed() -> None:
    told = _told(STARTED, FRAME)
    rows = [document["indices"] for name, document in told if name == "stream_datum"]
    assert rows == [{"start": 0, "stop": 20 - FLUSH + 1}] * 3


def test_the_live_reconstruction_does_not_end_the_run() -> None:
    of_recon = Failed("too little memory", 5, source="recon")
    told = _told(STARTED, of_recon, FRAME, _done("complete", 60), RunDone(Path("runs/a"), _result("complete", 60)))
    assert [name for name, _ in told].count("stop") == 1 and told[-1][0] == "stop"
    assert told[-1][1]["num_events"] == {"primary": 60}


@pytest.mark.parametrize(("status", "exit_status"), [("stopped", "abort"), ("failed", "fail"), ("complete", "fail")])
def test_a_scan_that_fails_says_why(status: str, exit_status: str) -> None:
    name, stop = _told(STARTED, FRAME, _done(status, 20), Failed("the disk is full", 5))[-1]
    assert (name, stop["exit_status"], stop["reason"]) == ("stop", exit_status, "the disk is full")
