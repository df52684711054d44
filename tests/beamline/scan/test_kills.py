"""kill -9 at random moments of a scan: every committed frame is in the file, intact and with its angle.

What a kill leaves is what had reached the file system by then. So one scan stands for many kills: it is stopped
(SIGSTOP), its files are copied, it goes on, and is killed in the end.
"""

import multiprocessing
import os
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext
from multiprocessing.connection import Connection
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.config.models import StorageSection
from beamline.core.errors import ConfigError, DataError
from beamline.features.files.validate import validate
from beamline.plan.passes import Choice
from beamline.scan import recorder
from beamline.scan.resume import open_for_resume, recover_run
from beamline.scan.run import run_scan
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.recorded_frames import decisions_in, pass_ends_in
from beamline.storage.writer_lock import QUIET
from drivers.base.frame import FrameKind
from tests.beamline.chosen import Chooser, Scripted, choosing
from tests.beamline.fakes import FakeInstrument, assert_true, decode
from tests.beamline.ran import small

VIEWS, FRAMES, SECONDS = 200, 207, 0.002  # s a frame, of real time
FIRST, PASS = 5, 50  # row of the first view, and views of a pass
WORDS = (f"scan.angles.views={VIEWS}", f"scan.pass_views={PASS}", "scan.period_s=0.05")

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a process that is forked is killed")


@pytest.fixture(autouse=True)
def _no_pause_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a virtual clock frames come faster than any disk takes them; a pause for it exposes frames not kept."""
    monkeypatch.setattr(recorder, "hold_for_backlog", lambda *_: None)


def _scan(runs: Path, step: bool, taken: Connection, choose: Chooser | None = None) -> None:
    """It sends a byte for each frame."""

    def on_frame(number: int) -> None:
        os.write(taken.fileno(), b".")
        time.sleep(SECONDS)

    instrument = FakeInstrument(on_frame=on_frame)
    config = small(*WORDS, f"scan.mode={'step' if step else 'fly'}")
    with nullcontext() if choose is None else choosing(pytest.MonkeyPatch(), choose, PASS):
        run_scan(config, runs, instrument=instrument.connected())


def _assert_frames(path: Path, one_part: bool = True) -> int:
    """What the fake camera wrote into the pixels is what the file says of each frame."""
    with open_scan(path) as source:
        frames = list(source.frames())
    assert_true(frames)
    assert not one_part or [decode(frame.counts)[3] for frame in frames] == [frame.index for frame in frames]
    views = [frame.trigger for frame in frames if frame.kind is FrameKind.PROJECTION]
    assert len(set(views)) == len(views)
    return len(frames)


def _killed(folder: Path, moments: Sequence[float], step: bool, choose: Chooser | None = None) -> list[Path]:
    """The folders of runs of a scan as kills leave them, where there is one yet.

    A moment is the number of a frame, with a share of the time to the next one; they rise. Beyond the last
    frame the file is closed.
    """
    runs, folders, taken = folder / "runs", list[Path](), 0
    ours, theirs = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=_scan, args=(runs, step, theirs, choose))
    process.start()
    theirs.close()
    assert process.pid is not None
    for k, moment in enumerate(moments):
        while taken < min(int(moment), FRAMES):
            heard = len(os.read(ours.fileno(), min(int(moment), FRAMES) - taken))
            assert heard, "the scan has failed"
            taken += heard
        time.sleep((moment - taken) * SECONDS)
        os.kill(process.pid, signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
        if k == len(moments) - 1:
            process.kill()
        if runs.exists():
            folders += shutil.copytree(runs, folder / str(k)).iterdir()
        os.kill(process.pid, signal.SIGCONT)
    process.join()
    ours.close()
    for file in folder.rglob("*"):
        os.utime(file, (time.time() - 2 * QUIET,) * 2)
    return folders


def kills(folder: Path, n: int, scans: int, seed: int, steps: Sequence[bool]) -> dict[str, int]:
    """Of so many scans, and n moments of each; the scan is taken up again after one in eight."""
    rng = np.random.default_rng(seed)
    counted = dict.fromkeys(("recovered", "whole", "frames", "none", "resumed"), 0)
    for scan in range(scans):
        moments = np.sort(rng.uniform(0, 1.1 * FRAMES, n))
        runs = _killed(folder / str(scan), moments.tolist(), steps[scan % len(steps)])
        counted["none"] += n - len(runs)
        for k, run in enumerate(runs):
            try:
                done = recover_run(run)[0]
            except DataError:
                assert not (events := run / "events.jsonl").exists() or '"event": "frame"' not in events.read_text()
                done = []
            if not done or not done[0].frames:
                counted["none"] += 1
                continue
            assert done[0].dropped <= StorageSection().flush_every  # frames come faster than they are written
            assert _assert_frames(done[0].path) == done[0].frames
            counted["recovered" if done[0].changed else "whole"] += 1
            counted["frames"] += done[0].frames
            if k % 8 == 0:
                counted["resumed"] += _gone_on(run)
    return counted


def _gone_on(run: Path) -> bool:
    """Take the rest, and look at all; False where nothing was missing."""
    try:
        with open_for_resume(run) as series:
            instrument = FakeInstrument()
            instrument.clock.sleep(1e4)
            run_scan(series.config, series, instrument=instrument.connected())
    except ConfigError as error:
        assert "nothing is missing" in str(error)
        return False
    _assert_frames(run / "joined.h5", one_part=False)
    assert not [one for one in validate(run / "joined.h5", lambda done, of: None) if one.severity == "error"]
    with open_scan(run / "joined.h5") as source:
        assert (source.table.kinds == FrameKind.PROJECTION).sum() == VIEWS
    return True


@pytest.mark.slow
def test_a_few_kills(tmp_path: Path) -> None:
    counted = kills(tmp_path, 3, 1, 1, [False])
    assert counted["recovered"] + counted["whole"] + counted["none"] == 3


@pytest.mark.slow
def test_kills_of_a_scan_that_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of its four passes are taken twice; the kills come in the first, in its second time, and in the last."""
    script = [Choice.AGAIN, Choice.NEXT, Choice.AGAIN]
    moments = [FIRST + share * PASS for share in (0.5, 1.5, 3.7)]
    for run in _killed(tmp_path, moments, True, Scripted(script)):
        recover_run(run)
        with h5py.File(run / "scan.h5") as file:
            n = len(decisions_in(file))
            if pass_ends_in(file).size > n:  # just between the two, where the plan goes on
                continue
        with choosing(monkeypatch, Scripted(script[n:]), PASS), open_for_resume(run) as series:
            instrument = FakeInstrument()
            instrument.clock.sleep(1e4)
            run_scan(series.config, series, instrument=instrument.connected())
        with open_scan(run / "joined.h5") as source:
            frames = [frame for frame in source.frames() if frame.kind is FrameKind.PROJECTION]
            assert [values["choice"] for values in source.decisions] == script
            assert [sum(frame.index < end for frame in frames) // PASS for end in source.table.pass_ends] == [
                1,
                2,
                3,
                4,
            ]
            of_parts = SourceOptions(run / "part-2" / "scan.h5", earlier=(run / "scan.h5",))
            with open_scan(of_parts) as followed:  # as a live reconstruction reads them
                assert followed.table.pass_ends.tolist() == source.table.pass_ends.tolist()
                assert followed.decisions == source.decisions
        assert_true(frames)
        once = [*range(PASS)]
        assert [frame.trigger for frame in frames] == [*once, *once, *(PASS + i for i in (*once, *once))]


@pytest.mark.slow
@pytest.mark.long
def test_many_kills(tmp_path: Path) -> None:
    counted = kills(tmp_path, 4, 6, 0, [False, True])
    assert counted["recovered"] >= 12 and counted["resumed"] >= 2
