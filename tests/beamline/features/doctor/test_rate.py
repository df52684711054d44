"""The measurement of acquisition loses nothing, counts what is lost, and leaves nothing behind."""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from beamline.core.errors import DataError
from beamline.features.doctor import rate
from beamline.features.doctor.rate import FEWEST, REFERENCES, RING, STAGES, Load, rates, summary
from beamline.scan.recorder import Recorder
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame, FrameKind

LOAD = Load((24, 40), preview_bin=4, flush_every=16)


def measured(folder: Path, rounds: int = 2) -> list[rate.StageRun]:
    return list(rates(LOAD, folder, SystemClock(), 1e-3, rounds, lambda n, of, stage: None))


def test_each_stage_is_measured_once_a_round_and_its_file_removed(tmp_path: Path) -> None:
    taken = measured(tmp_path)
    rows = summary(LOAD, taken)
    assert [row.stage for row in rows] == list(STAGES)
    assert [one.stage for one in taken[: len(STAGES)]] != list(STAGES)  # another one is first in each round
    assert all(row.lost == 0 and row.lowest <= row.ratio <= row.highest for row in rows)
    assert rows[0].lowest == rows[0].highest == 1
    times = sorted(one.seconds / one.frames for one in taken if one.stage == rows[1].stage)
    assert rows[1].mb_per_s == pytest.approx(2 * 24 * 40 / 1e6 / (sum(times) / 2))
    assert list(tmp_path.iterdir()) == []


def test_all_that_stages_share_is_made_before_they_are_measured() -> None:
    load, shared = replace(LOAD), {"images", "digests", "memory"}
    assert not shared & vars(load).keys()
    load.prepare()
    assert shared <= vars(load).keys()


def test_a_frame_that_is_not_in_its_row_counts_as_lost(tmp_path: Path) -> None:
    frames = [LOAD.frame(row, FEWEST) for row in range(9)]
    frames[6] = replace(frames[6], counts=frames[7].counts)
    with rate._writer(LOAD, tmp_path, SystemClock()) as writer:
        for frame in frames:
            writer.append(frame, rate.digests(frame.counts, None, 4)[1])
    assert rate._lost(LOAD, writer.path, 9) == 1
    assert rate._lost(LOAD, writer.path, 12) == 1 + 3


def test_an_interrupt_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def put(recorder: Recorder, frame: Frame) -> None:
        if frame.index == 5:
            raise KeyboardInterrupt
        real(recorder, frame)

    real = Recorder.put
    monkeypatch.setattr(Recorder, "put", put)
    with pytest.raises(KeyboardInterrupt):
        measured(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_frames_beside_each_other_differ_and_views_follow_darks_and_flats() -> None:
    frames = [LOAD.frame(row, FEWEST) for row in range(2 * REFERENCES + RING + 1)]
    assert all((a.counts != b.counts).any() for a, b in pairwise(frames))
    kinds = [FrameKind.DARK] * REFERENCES + [FrameKind.FLAT] * REFERENCES + [FrameKind.PROJECTION] * (RING + 1)
    assert [frame.kind for frame in frames] == kinds


def test_a_folder_that_is_not_there_and_a_full_disk_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(DataError, match="is no folder"):
        measured(tmp_path / "none")
    full = shutil.disk_usage(tmp_path)._replace(free=FEWEST * LOAD.frame_bytes)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: full)
    with pytest.raises(DataError, match="Nothing was written"):
        measured(tmp_path)
