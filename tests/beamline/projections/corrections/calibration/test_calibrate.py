"""--calibrate: shifts and the axis are measured from the projections, and change only the geometry."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.core.errors import ConfigError
from beamline.projections.corrections.air import Air
from beamline.projections.corrections.calibration.calibrate import Calibrate
from beamline.projections.corrections.poses import PosesOfFile
from beamline.projections.prepared import PreparedProjections
from beamline.projections.protocols import PrepStep
from beamline.projections.selection import Selection
from beamline.storage.pose_table import read_poses
from recon.base.geometry import Geometry
from recon.features.calibration.joint import knowable
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import DARK, frames_through, write_flagged
from tests.recon.bodies import balls

N, SHAPE, PITCH, AXIS = 48, (24, 48), 0.5, 23.9
JUMP = np.outer(np.arange(N) >= 20, (2.5, -1.5))
LEARN = Calibrate(("axis", "shifts"))


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Counts of balls that jump, in pixels of half a millimetre."""
    path = tmp_path_factory.mktemp("calibrate") / "scan.h5"
    geometry = Geometry.parallel(
        np.linspace(0, np.pi, N, endpoint=False), SHAPE, pixel_pitch=PITCH, axis_col=AXIS, shifts=JUMP
    )
    counts = DARK + 40_000 * np.exp(-balls(10, 12).views(geometry))
    return write_flagged(path, frames_through(counts, geometry.angles, beam=40_000), {}, pixel_size_mm=PITCH)


def prepared(path: Path, *steps: PrepStep, **selected: object) -> PreparedProjections:
    asked: dict[str, Any] = {"axis_col": AXIS + 0.8, "steps": (Air("none"), *steps), **selected}
    return prepare(path, Selection(**asked))[0]


def test_places_and_axis_enter_the_geometry_and_no_pixel_is_resampled(scan: Path) -> None:
    found, plain = prepared(scan, LEARN), prepared(scan)
    np.testing.assert_array_equal(found.seen.data, plain.seen.data)
    rest, axis = knowable(found.geometry.shifts - JUMP, found.geometry.angles)
    assert np.sqrt(np.mean(rest**2)) < 0.1
    assert (
        found.geometry.axis_col + axis == pytest.approx(AXIS, abs=0.1)
        and found.origin.axis_col == found.geometry.axis_col
    )
    done = found.origin.done["calibrate"]
    assert done.sentence.startswith("Geometry calibrated: the axis moves by +")
    assert "The deviation of held-out projections fell from" in done.sentence
    assert done.parameters is not None and done.parameters["calibrate_confirmed"] == "axis,shifts"
    assert plain.origin.done["calibrate"].sentence == ""


def test_binned_pixels_and_chosen_views_take_their_part(scan: Path) -> None:
    """With binning, shifts count in binned pixels; views held out are put in their places, too."""
    found = prepared(scan, LEARN, binning=2, views="every:2", rows=(2, 22))
    assert found.geometry.detector_shape == (10, 24) and found.geometry.n_views == N // 2
    rest, _ = knowable(found.geometry.shifts - JUMP[::2] / 2, found.geometry.angles)
    assert np.sqrt(np.mean(rest**2)) < 0.1
    assert found.lines.unseen is not None and found.lines.unseen.geometry.shifts.any()


@pytest.mark.parametrize(("off", "given", "told"), [(0.0, None, False), (2.0, None, True), (2.0, AXIS, False)])
def test_poses_of_a_volume_with_another_axis_are_told(
    scan: Path, tmp_path: Path, off: float, given: float | None, told: bool
) -> None:
    rows = "\n".join(f"{view},{col},{row}" for view, (col, row) in enumerate(JUMP))
    (tmp_path / "poses.csv").write_text(f"view,shift_col_px,shift_row_px\n{rows}\n")
    table = read_poses(str(tmp_path / "poses.csv"))

    def taken(known: float | None) -> tuple[PreparedProjections, list[str]]:
        steps = Air("none"), PosesOfFile(replace(table, axis_col=known))
        return prepare(scan, Selection(axis_col=given, steps=steps))

    _, warnings = taken(taken(None)[0].origin.axis_col + off)
    assert any("were found with the rotation axis" in each for each in warnings) is told


def test_a_growing_scan_and_poses_of_a_file_are_refused(scan: Path, tmp_path: Path) -> None:
    assert "it uses all projections" in LEARN.needs_finished and Calibrate().needs_finished == ""
    table = tmp_path / "poses.csv"
    rows = "\n".join(f"{view},1,0" for view in range(N))
    table.write_text(f"view,shift_col_px,shift_row_px\n{rows}\n")
    with pytest.raises(ConfigError, match=r"--calibrate determines from the projections what .*Give either"):
        prepared(scan, replace(LEARN, terms=("roll",)), PosesOfFile(read_poses(str(table))))
    with pytest.raises(ValueError, match="'lean'"):
        Calibrate.__dataclass_fields__["terms"].metadata["option"].parse("axis,lean")
