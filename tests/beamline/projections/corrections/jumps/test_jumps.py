"""Projections after a jump of the sample are left out, and one line says why."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.monitor.check import Flag, Level
from beamline.monitor.motion import MotionCheck
from beamline.monitor.opposite import OppositeCheck
from beamline.projections.corrections.air import Air
from beamline.projections.corrections.calibration.calibrate import Calibrate
from beamline.projections.preparation import Preparation
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import DARK, frames_through, write_flagged
from tests.recon.voxels.balls import ball_views

SHAPE = (8, 48)
ANGLES = np.radians(np.arange(0, 180, 3.0))
JUMP, FIRST = 41, 4  # view; row of the first view: two darks, two flats
LATER = np.arange(ANGLES.size) >= JUMP
SELECTION = Selection(axis_col=23.5, steps=(Air("none"),))


def scan(path: Path, views: NDArray[np.float32], *jumps: int) -> Path:
    counts = DARK + 40_000 * np.exp(-views) + np.random.default_rng(0).normal(0, 40, views.shape)
    rows = [FIRST + view for view in jumps]
    flags = [Flag(MotionCheck.name, Level.ALARM, row, 1.0, 0.5, "") for row in rows]
    flags += [Flag(OppositeCheck.name, Level.WARN, row + 3, 1.0, 0.5, "") for row in rows]
    return write_flagged(path / "scan.h5", frames_through(counts, ANGLES, beam=40_000), {}, flags=flags)


def prepared(path: Path, selection: Selection = SELECTION) -> tuple[PreparedProjections, str]:
    found, told = prepare(path, selection)
    return found, " ".join(told)


def moved(x: float, z: float) -> NDArray[np.float32]:
    return ball_views(ANGLES, SHAPE, 0.0, (np.where(LATER, x, 0), 0.0, np.where(LATER, z, 0)))


def test_views_after_a_jump_are_left_out(tmp_path: Path) -> None:
    found, told = prepared(scan(tmp_path, moved(1.5, 1.0), JUMP), replace(SELECTION, views="first:30"))
    assert found.geometry.n_views == 30 and found.origin.left_out == 19 and found.sources.view_weights is None
    assert "The sample jumped at frame 45. 19 projections are left out" in told
    assert "`--calibrate shifts` uses all" in told and found.origin.done["jumps"].sentence in told


def test_another_sample_after_the_jump_is_left_out(tmp_path: Path) -> None:
    views = moved(0.0, 0.0)
    views[LATER] = ball_views(ANGLES[LATER], SHAPE, seed=1)
    found, told = prepared(scan(tmp_path, views, JUMP))
    assert found.geometry.n_views == JUMP and found.origin.left_out == 19 and not found.geometry.shifts.any()
    assert "19 projections are left out, because the sample was at another position" in told


def test_spoilt_views_between_two_false_alarms_hide_no_jump(tmp_path: Path) -> None:
    views = moved(2.0, 2.0)
    views[15:20] += np.random.default_rng(1).normal(0, 0.5, (5, *SHAPE)).astype(np.float32)
    found, told = prepared(scan(tmp_path, views, 15, 20, JUMP), replace(SELECTION, binning=2))
    assert told.startswith("The sample jumped at frame 45. 19 projections are left out")
    assert "The monitor reported motion at frames 19, 24, but the projections show no jump" in told
    assert found.geometry.n_views == JUMP


def test_an_alarm_without_a_jump_changes_nothing(tmp_path: Path) -> None:
    found, told = prepared(scan(tmp_path, moved(0.0, 0.0), 20, 22))
    assert found.geometry.n_views == ANGLES.size and not found.geometry.shifts.any()
    assert told.startswith("The monitor reported motion at frames 24, 26, but the projections show no jump")


@pytest.mark.parametrize(
    ("selection", "said"),
    [
        (SELECTION.with_steps(Preparation("ignore")), "--flags ignore: 1 projection with an alarm"),
        (replace(SELECTION, cone=(100.0, 200.0)), "In a cone beam jumps cannot be checked"),
    ],
)
def test_who_wants_them_as_they_are_and_cones_get_them_so(tmp_path: Path, selection: Selection, said: str) -> None:
    found, told = prepared(scan(tmp_path, moved(1.5, 1.0), JUMP), selection)
    assert found.geometry.n_views == ANGLES.size and not found.geometry.shifts.any()
    assert said in told


@pytest.mark.slow
def test_all_views_are_used_where_the_place_of_each_is_learnt(tmp_path: Path) -> None:
    found, told = prepared(scan(tmp_path, moved(1.5, 1.0), JUMP), SELECTION.with_steps(Calibrate(("shifts",))))
    assert found.geometry.n_views == ANGLES.size and "left out" not in told
    down = found.geometry.shifts[LATER, 1].mean() - found.geometry.shifts[~LATER, 1].mean()
    assert down == pytest.approx(1.0, abs=0.2)
