"""The runs in a folder: their description, whatever happened to them; newest first; quickly."""

import errno
import os
import sys
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from beamline.config.load import resolved_yaml
from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Event
from beamline.scan.control import State, running
from beamline.scan.resume import NoFrame, open_for_resume, recover_run
from beamline.scan.runs import cells, describe, newest, runs_in
from beamline.storage import writer_lock
from beamline.storage.run_record import RecordFile, RunRecord, read_record, write_record
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import Ran, ended_run, small
from tests.messages import refused

FRAMES = 3 + 2 + 12 + 2  # darks, flats, views, flats of the configuration `small`


def _run(runs: Path, at: int | None = None) -> Path:
    """A run, whole or aborted at its frame number `at`."""
    return Ran(runs, FakeInstrument()).folder if at is None else ended_run(runs, "aborted", at=at)


def _part(folder: Path, record: RunRecord) -> Path:
    """A part that has ended, or died."""
    folder.mkdir(parents=True)
    for name in ("config.resolved.yaml", "events.jsonl"):
        (folder / name).touch()
    write_record(folder, record)
    return folder


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


def test_a_run_whose_process_was_killed_has_died_with_the_frames_of_its_file(tmp_path: Path) -> None:
    run = _run(tmp_path, 9)
    stored = describe(run).frames
    write_record(run, RunRecord(State.ACQUIRING, sample="battery", frames=2, planned=FRAMES))
    died = describe(run)
    assert (died.state, died.frames, died.planned) == ("died", stored, FRAMES)
    assert "--resume" in died.next_step


def test_parts_of_a_resumed_run_are_one_run(tmp_path: Path) -> None:
    """As run_scan writes it: what a later part says of its frames is of the joined file, of its flags its own."""
    first = RunRecord(State.STOPPED, True, "a", 9, planned=20, flags={"mass": {"warn": 2}})
    run = _part(tmp_path / "2026-01-02T03-04-05_a", first)
    later = RunRecord(State.DONE, True, "a", 22, True, 13, {"mass": {"warn": 1, "alarm": 4}})
    _part(run / "part-2", later)
    found = describe(run)
    assert runs_in(tmp_path) == [run]
    assert (found.frames, found.parts, found.state, found.planned) == (22, 2, "done", 9 + 13)
    assert found.flags == {"mass": {"warn": 3, "alarm": 4}}
    write_record(run / "part-2", replace(later, state=State.ACQUIRING, over=False, frames=5))
    assert (describe(run).frames, describe(run).state) == (9 + 5, "died")


def test_a_run_never_has_more_frames_than_planned(tmp_path: Path) -> None:
    """Each part takes darks and flats again, so that a run of three parts takes more than its first one was to take."""
    run = _part(tmp_path / "2026-01-02T03-04-05_a", RunRecord(State.STOPPED, True, "a", 48, planned=120))
    _part(run / "part-2", RunRecord(State.STOPPED, True, "a", 90, True, 92))
    _part(run / "part-3", RunRecord(State.STOPPED, True, "a", 122, True, 70))
    assert "122 of 160 in 3 parts" in cells(describe(run))


def test_newest_first_also_within_a_second(tmp_path: Path) -> None:
    names = ["2026-01-02T03-04-05_a", "2026-01-02T03-04-05_a-2", "2026-01-02T03-04-05_a-10", "2026-01-02T03-04-06_a"]
    runs = [_part(tmp_path / name, RunRecord(State.DONE, True)) for name in names]
    renamed = _part(tmp_path / "the good one", RunRecord(State.DONE, True))
    os.utime(renamed / "config.resolved.yaml", (7.0, 7.0))  # it began then
    (tmp_path / "no run").mkdir()
    assert runs_in(tmp_path) == [*reversed(runs), renamed]
    assert newest(tmp_path) == runs[-1]
    with refused(ConfigError):
        newest(tmp_path / "no run")


@pytest.mark.parametrize(
    "record", [b"", b"\xff\xfe\n[1]\n7\n", b'{"state": "done", "over": true, "frames": "x"}', b'{"state"', b"\0" * 99]
)
def test_a_damaged_record_hides_no_run(tmp_path: Path, record: bytes) -> None:
    run = _part(tmp_path / "2026-01-02T03-04-05_cell", RunRecord(State.DONE))
    (run / "state.json").write_bytes(record)
    found = describe(run)
    assert (found.sample, found.frames, found.state) == ("cell", None, "not known")


@pytest.mark.parametrize(("at", "state"), [(None, "done"), (8, "stopped")])
def test_a_run_of_an_earlier_version_has_the_state_of_its_file(tmp_path: Path, at: int | None, state: str) -> None:
    run = _run(tmp_path, at)
    now = describe(run)
    (run / "state.json").unlink()
    earlier = describe(run)
    assert (earlier.state, earlier.frames, earlier.sample) == (state, now.frames, "battery")


FIT = """
import json, pathlib, sys, time
print(json.dumps({"event": "state", "state": "ready", "message": "", "time": 0.0}), flush=True)
def wait(name):
    while not pathlib.Path(sys.argv[1], name).exists():
        time.sleep(0.01)
wait("closed")
progress = {"event": "progress", "stage": "fit", "of": 9000, "per_s": 1.0, "eta_s": 1e3, "time": 0.0}
for n in range(9000):
    print(json.dumps(progress | {"n": n}), flush=n == 8999)
wait("listed")
print(json.dumps({"event": "done", "time": 0.0, "output": "v.h5"}))
"""


def test_a_scan_whose_last_fit_says_much_is_listed_as_it_is_until_its_process_ends(tmp_path: Path) -> None:
    """The fit writes a megabyte of events after the scan's last one."""
    listed, runs = list[tuple[str, int | None]](), tmp_path / "runs"

    def look(event: Event) -> None:
        if event.event == "scan_done":
            (tmp_path / "closed").touch()
        elif event.event == "progress" and event.data["n"] % 1000 == 999:
            (run,) = map(describe, runs_in(runs))
            listed.append((run.state, run.frames))
            assert running(runs) == [newest(runs)] == [run.folder]
            if event.data["n"] == 8999:
                (tmp_path / "listed").touch()

    command = [sys.executable, "-c", FIT, str(tmp_path)]
    ran = Ran(runs, FakeInstrument(), live=lambda scan, volume: command, heard=look)
    assert (ran.folder / "events.jsonl").stat().st_size > 2**20
    assert listed == [("finishing", FRAMES)] * 9
    assert (describe(ran.folder).state, describe(ran.folder).frames) == ("done", FRAMES)


def test_of_a_kill_in_the_last_fit_the_run_has_died_and_recover_says_that_it_is_complete(tmp_path: Path) -> None:
    run = _run(tmp_path)
    record = read_record(run)
    assert record is not None
    flags = {"mass": {"info": 2, "warn": 1}}  # the file has none of the level info
    write_record(run, replace(record, state=State.FINISHING, over=False, flags=flags))
    died = describe(run)
    assert (died.state, died.frames, died.flags) == ("died", FRAMES, flags)
    assert f"`beamline recover {run}` marks the run as ended" in died.next_step
    recover_run(run)
    assert (describe(run).state, describe(run).frames, describe(run).next_step) == ("done", FRAMES, "")
    assert describe(run).flags == flags


def test_of_a_kill_before_the_first_frame_nothing_that_refuses_is_advised(tmp_path: Path) -> None:
    run = _part(tmp_path / "a", RunRecord(State.PREPARING, planned=FRAMES))
    for content in (None, b"", b"\x89HDF\r\n\x1a\n"):  # its file was not made, or not to its end
        if content is not None:
            (run / "scan.h5").write_bytes(content)
        died = describe(run)
        assert (died.state, died.frames) == ("died", 0)
        assert died.next_step == "The run ended before its first frame: start the scan again."
    with refused(DataError):
        recover_run(run)
    (run / "config.resolved.yaml").write_text(resolved_yaml(small()))
    with refused(NoFrame), open_for_resume(run):
        pass


def test_the_files_of_a_run_without_its_events_are_recovered_and_a_folder_without_a_scan_is_no_run(
    tmp_path: Path,
) -> None:
    run = _run(tmp_path, 9)
    for name in ("events.jsonl", "state.json"):
        (run / name).unlink()
    assert [done.frames for done in recover_run(run)[0]] == [10]
    (run / "scan.h5").unlink()
    with pytest.raises(DataError, match=r"is not the folder of a run: it has no scan\.h5\. Nothing was changed"):
        recover_run(run)


def test_what_lives_is_neither_resumed_nor_recovered_and_what_is_recovered_is_in_preparation(tmp_path: Path) -> None:
    run = _run(tmp_path, 9)
    file = RecordFile(run, RunRecord(State.FINISHING, sample="battery"))
    for take_up in (recover_run, open_for_resume):
        with pytest.raises(ConfigError, match=r"still running.*Nothing was changed"), ExitStack() as opened:
            taken = take_up(run)
            opened.enter_context(taken)  # type: ignore[arg-type]
    assert describe(run).state == "finishing"
    file.close()
    assert describe(run).state == "failed"  # by a process that ended without a word of how
    with open_for_resume(run), pytest.raises(ConfigError, match="another process is continuing or recovering this run"):
        assert describe(run).state == "preparing"
        recover_run(run)
    assert describe(run).state == "failed"


def test_on_a_disk_without_locks_no_run_is_said_to_have_died(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_lock(file: int, *, exclusive: bool) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(writer_lock, "_lock", no_lock)
    file = RecordFile(_part(tmp_path / "a", RunRecord(State.IDLE)), RunRecord(State.ACQUIRING, frames=3))
    assert (describe(tmp_path / "a").state, describe(tmp_path / "a").frames) == (State.ACQUIRING, 3)
    file.close()
    assert describe(tmp_path / "a").state == State.FAILED
