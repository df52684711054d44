"""Projections with an alarm are left out, with a warning count half; with --flags ignore all count equally."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.monitor.check import Level
from beamline.projections.corrections.air import Air
from beamline.projections.preparation import Preparation
from beamline.projections.prepared import hold_out
from beamline.projections.selection import Selection
from beamline.projections.usable_views import WARNED_WEIGHT
from beamline.storage.rules.flag_policy import FEWEST_VIEWS
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import TwoCylinders, frames_of, write_flagged
from tests.slow_cases import others_slow

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(2, 40))
SELECTION = Selection(axis_col=SCAN.axis_col, steps=(Air("none"),))
FIRST = 4  # row of the first view: two darks, two flats
ALARMS = {FIRST + i: Level.ALARM for i in range(10, 16)}
LEVELS = {**ALARMS, FIRST + 3: Level.WARN, FIRST + 20: Level.WARN}


def scan(path: Path, levels: dict[int, Level] = LEVELS) -> Path:
    """The views with an alarm are dark: without the flags they would ruin the volume."""
    frames = [replace(f, counts=f.counts // 8) if levels.get(f.index) is Level.ALARM else f for f in frames_of(SCAN)]
    return write_flagged(path / "scan.h5", frames, levels)


def test_what_is_left_out_and_what_weighs_half_is_told_in_a_line(tmp_path: Path) -> None:
    found, told = prepare(scan(tmp_path), SELECTION)
    used = sorted(set(range(FIRST, FIRST + 30)) - set(ALARMS))
    np.testing.assert_array_equal(found.ids, used)
    np.testing.assert_allclose(found.geometry.angles, SCAN.angles[np.array(used) - FIRST], atol=1e-9)
    np.testing.assert_allclose(found.seen.data, SCAN.line_integrals()[np.array(used) - FIRST], atol=1e-4)
    assert found.sources.view_weights is not None
    weights = {row: w for row, w in zip(used, found.sources.view_weights.tolist(), strict=True) if w != 1}
    assert weights == {FIRST + 3: WARNED_WEIGHT, FIRST + 20: WARNED_WEIGHT}
    assert found.views.weights[...].shape == (24, 2, 40)
    rays = hold_out(found, 8, advice="").views.weights[...]
    assert rays.shape == (24, 2, 40) and (rays[-3:] == 1).all()
    (line,) = told
    assert line.startswith("Of 30 projections, 6 have an alarm and are left out (beam 6 alarm), 2 have a warning")
    assert "(beam 2 warn). They leave 42° without a projection. --flags" in line  # six of them side by side, 6° apart
    assert (found.origin.left_out, found.origin.n_projections) == (6, 30)


def test_a_selection_and_the_views_held_out_are_of_the_good_views(tmp_path: Path) -> None:
    found, _ = prepare(scan(tmp_path), replace(SELECTION, views="fixed:8"))
    assert found.lines.held_out.size
    used = np.round(np.degrees(found.lines.geometry.angles) / 6).astype(int)
    assert not set(used + FIRST) & set(ALARMS)
    everything, _ = prepare(tmp_path / "scan.h5", SELECTION)
    kept = hold_out(everything, 4, advice="")
    assert kept.sources.view_weights is not None
    expected = [LEVELS.get(row) is Level.WARN for row in kept.ids.tolist()]
    np.testing.assert_array_equal(kept.sources.view_weights == WARNED_WEIGHT, expected)


def test_flags_may_be_ignored(tmp_path: Path) -> None:
    found, told = prepare(scan(tmp_path), SELECTION.with_steps(Preparation("ignore")))
    assert found.geometry.n_views == 30 and found.sources.view_weights is None and found.views.weights is None
    assert told[0] == "--flags ignore: 6 projections with an alarm and 2 with a warning are used as they are."


@pytest.mark.parametrize("n", others_slow([FEWEST_VIEWS, FEWEST_VIEWS - 1, 0], 2))
def test_too_few_good_views_are_refused_with_figures(tmp_path: Path, n: int) -> None:
    path = scan(tmp_path, {FIRST + i: Level.ALARM for i in range(n, 30)})
    if n >= FEWEST_VIEWS:
        assert prepare(path, SELECTION)[0].geometry.n_views == n
        return
    with pytest.raises(DataError, match=f"{n} of 30.*--flags ignore"):
        prepare(path, SELECTION)


def test_a_file_without_flags_is_judged_where_that_is_wanted(tmp_path: Path) -> None:
    frames = frames_of(SCAN)
    frames[9], frames[10] = (replace(frames[i], counts=frames[8].counts) for i in (9, 10))
    path = write_flagged(tmp_path / "s.h5", frames, {})
    assert prepare(path, SELECTION)[0].geometry.n_views == 30
    found, told = prepare(path, SELECTION.with_steps(Preparation("judge")))
    assert found.geometry.n_views == 28 and "2 have an alarm and are left out (stuck 2 alarm)" in told[0]
