"""Kill -9 at random moments of a running scan: every frame that was committed is there, whole and at its angle."""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from beamline.config.models import StorageSection
from beamline.core.errors import ConfigError, DataError
from beamline.scan import recorder
from beamline.scan.resume import open_for_resume, recover_run
from beamline.scan.run import run_scan
from beamline.storage.readers.open import open_scan
from beamline.storage.rules.validate import validate
from beamline.storage.writer_lock import QUIET
from drivers.base.frame import FrameKind
from tests.beamline.fakes import COUNT, FakeInstrument, decode
from tests.beamline.ran import small

VIEWS, SECONDS = 200, 0.002  # s a frame, of real time
WORDS = (f"scan.angles.views={VIEWS}", "scan.period_s=0.05")

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a process that is forked is killed")


@pytest.fixture(autouse=True)
def _no_pause_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a virtual clock frames come faster than any disk takes them; a pause for it exposes frames not kept."""
    monkeypatch.setattr(recorder, "BacklogGuard", lambda *_: lambda waiting: None)


def _scan(runs: Path, step: bool) -> None:
    instrument = FakeInstrument(on_frame=lambda number: time.sleep(SECONDS))
    run_scan(small(*WORDS, f"scan.mode={'step' if step else 'fly'}"), runs, instrument=instrument.connected())


def _seconds(runs: Path, step: bool) -> float:
    """That a scan takes here, so that kills fall into it on any machine."""
    begin = time.monotonic()
    _scan(runs, step)
    return time.monotonic() - begin


def _assert_frames(path: Path, one_part: bool = True) -> int:
    """What the fake camera wrote into the pixels is what the file says of each frame."""
    with open_scan(path) as source:
        frames = list(source.frames())
    for frame in frames:
        count, is_open, is_in, number = decode(frame.counts)
        assert (is_open, is_in) == (frame.kind is not FrameKind.DARK, frame.kind is not FrameKind.FLAT)
        assert frame.angle == pytest.approx(count * COUNT, abs=COUNT)
        if one_part:
            assert number == frame.index
    views = [frame.trigger for frame in frames if frame.kind is FrameKind.PROJECTION]
    assert len(set(views)) == len(views)
    return len(frames)


def _killed(runs: Path, seconds: float, step: bool) -> Path | None:
    """The folder of a scan that was killed after so many s; None where it had none yet."""
    process = multiprocessing.get_context("fork").Process(target=_scan, args=(runs, step))
    process.start()
    time.sleep(seconds)
    process.kill()
    process.join()
    for file in runs.rglob("*"):
        os.utime(file, (time.time() - 2 * QUIET,) * 2)
    return next(iter(runs.glob("*")), None)


def kills(folder: Path, n: int, seed: int) -> dict[str, int]:
    rng, found = np.random.default_rng(seed), dict.fromkeys(("recovered", "whole", "frames", "none", "resumed"), 0)
    _scan(folder / "warm", step=False)
    whole = [_seconds(folder / f"whole{step:d}", step) for step in (False, True)]
    for k in range(n):
        step, runs = bool(k % 2), folder / str(k)
        run = _killed(runs, float(rng.uniform(0.02, whole[step])), step)
        try:
            done = recover_run(run)[0] if run is not None else []
        except DataError:
            assert run is not None
            assert not (events := run / "events.jsonl").exists() or '"event": "frame"' not in events.read_text()
            done = []
        if not done or not done[0].frames:
            found["none"] += 1
            continue
        assert run is not None
        assert done[0].dropped <= StorageSection().flush_every  # frames come faster than they are written
        assert _assert_frames(done[0].path) == done[0].frames
        found["recovered" if done[0].changed else "whole"] += 1
        found["frames"] += done[0].frames
        if k % 4 == 0:
            found["resumed"] += _gone_on(run)
    return found


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
        assert (source.image_key == FrameKind.PROJECTION).sum() == VIEWS
    return True


def test_a_few_kills(tmp_path: Path) -> None:
    found = kills(tmp_path, 3, 1)
    assert found["recovered"] + found["whole"] + found["none"] == 3


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_two_hundred_kills(tmp_path: Path) -> None:
    found = kills(tmp_path, 200, 0)
    print(found)
    assert found["recovered"] >= 100
