"""Runs of a folder: what they say of themselves, whatever became of them; newest first; quickly."""

import json
import os
import shutil
import time
from pathlib import Path

import pytest

from beamline.core.errors import ConfigError
from beamline.core.stop import StopRequest
from beamline.scan.runs import describe, newest, runs_in
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import Ran

FRAMES = 3 + 2 + 12 + 2  # darks, flats, views, flats of the configuration `small`


def _run(runs: Path, at: int | None = None, *, abort: bool = True) -> Path:
    """A run, whole or ended at its frame number `at`."""
    stop = StopRequest()

    def end(number: int) -> None:
        if number == at:
            (stop.abort if abort else stop.stop)()

    ran = Ran(runs, FakeInstrument(on_frame=end), stop=stop)
    return ran.folder


def _log(run: Path, *events: object) -> Path:
    run.mkdir(parents=True)
    (run / "events.jsonl").write_text("".join(f"{json.dumps(event)}\n" for event in events))
    return run


def _began(sample: str) -> dict[str, object]:
    return {"event": "run_started", "time": 7.0, "sample": sample, "n_frames": 20}


def test_a_whole_run(tmp_path: Path) -> None:
    run = _run(tmp_path)
    found = describe(run)
    assert (found.sample, found.frames, found.planned, found.state, found.parts) == (
        "battery",
        FRAMES,
        FRAMES,
        "done",
        1,
    )
    assert found.bytes == sum(file.stat().st_size for file in run.rglob("*") if file.is_file())
    assert abs(found.time - time.time()) < 100  # the fake's clock stands at another time


def test_a_run_that_ended_early_has_its_frames_and_a_reason(tmp_path: Path) -> None:
    stopped, aborted = (describe(_run(tmp_path / str(abort), 8, abort=abort)) for abort in (False, True))
    assert (stopped.state, aborted.state) == ("stopped", "aborted")
    assert 0 < (aborted.frames or 0) <= (stopped.frames or 0) < FRAMES == stopped.planned


def test_a_run_whose_process_was_killed_has_died_with_the_frames_of_its_file(tmp_path: Path) -> None:
    run = _run(tmp_path, 9)
    stored = describe(run).frames
    events = (run / "events.jsonl").read_text().splitlines()
    end = next(i for i, line in enumerate(events) if '"finishing"' in line)
    (run / "events.jsonl").write_text("\n".join(events[:end]) + '\n{"event": "fra')
    (run / "control").mkdir()  # nobody took it away
    died = describe(run)
    assert (died.state, died.frames) == ("died", stored)


def test_parts_of_a_resumed_run_are_one_run(tmp_path: Path) -> None:
    """As run_scan writes it: what a later part says of its frames is of the joined file, of its flags its own."""
    run = _log(
        tmp_path / "2026-01-02T03-04-05_a",
        _began("a"),
        {"event": "scan_done", "path": "scan.h5", "n_frames": 9, "flags": {"mass": {"warn": 2}}},
        {"event": "state", "state": "stopped"},
        {"event": "failed", "message": "stopped"},
    )
    _log(
        run / "part-2",
        _began("a") | {"n_frames": 13},
        {"event": "state", "state": "done"},
        {"event": "done", "path": "joined.h5", "n_frames": 22, "flags": {"mass": {"warn": 1, "alarm": 4}}},
    )
    found = describe(run)
    assert runs_in(tmp_path) == [run]
    assert (found.frames, found.parts, found.state, found.planned) == (22, 2, "done", 20)
    assert found.flags == {"mass": {"warn": 3, "alarm": 4}}
    (run / "part-2" / "events.jsonl").write_text('{"event": "frame", "n": 5}\n')
    assert (describe(run).frames, describe(run).state) == (None, "died")


def test_newest_first_also_within_a_second(tmp_path: Path) -> None:
    names = ["2026-01-02T03-04-05_a", "2026-01-02T03-04-05_a-2", "2026-01-02T03-04-05_a-10", "2026-01-02T03-04-06_a"]
    runs = [_log(tmp_path / name, _began("a")) for name in names]
    renamed = _log(tmp_path / "the good one", _began("b"))  # began 7 s after the epoch
    (tmp_path / "no run").mkdir()
    assert runs_in(tmp_path) == [*reversed(runs), renamed]
    assert newest(tmp_path) == runs[-1]
    with pytest.raises(ConfigError, match="no run"):
        newest(tmp_path / "no run")


@pytest.mark.parametrize(
    "log",
    [b"", b"\xff\xfe\n[1]\n7\n", b'{"event": "done", "n_frames": "x", "flags": [1], "path": 3}\n{"event"', b"\0" * 99],
)
def test_a_damaged_log_hides_no_run(tmp_path: Path, log: bytes) -> None:
    run = tmp_path / "2026-01-02T03-04-05_cell"
    run.mkdir()
    (run / "events.jsonl").write_bytes(log)
    found = describe(run)
    assert (found.sample, found.frames, found.state) == ("cell", None, "died")


@pytest.mark.bench
def test_five_hundred_runs_take_less_than_two_seconds(tmp_path: Path) -> None:
    """A tenth of them have no end in their log; each log has a megabyte of frames in its middle."""
    run = _run(tmp_path / "one", 9)
    began, *rest = (run / "events.jsonl").read_text().splitlines()
    middle = json.dumps({"event": "frame", "time": 0.0, "n": 1, "of": 2})
    whole = "\n".join([began, *([middle] * 20_000), *rest, ""])
    (run / "events.jsonl").unlink()
    (tmp_path / "whole").write_text(whole)
    (tmp_path / "cut").write_text("\n".join([began, middle, ""]))
    for i in range(500):
        one = tmp_path / "runs" / f"2026-01-02T03-{i // 60:02}-{i % 60:02}_a"
        one.mkdir(parents=True)
        os.link(run / "scan.h5", one / "scan.h5") if hasattr(os, "link") else shutil.copy(run / "scan.h5", one)
        os.link(tmp_path / ("whole" if i % 10 else "cut"), one / "events.jsonl")
    began_at = time.process_time()
    found = [describe(each) for each in runs_in(tmp_path / "runs")]
    assert time.process_time() - began_at < 2
    assert {each.state for each in found} == {"aborted", "died"}
    assert len({each.frames for each in found}) == 1
