"""The file of a simulated scan says what its frames show."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from beamline.features.simulate.write import write_scan
from beamline.projections.corrections.width import Width
from beamline.projections.selection import Selection, geometry_of
from beamline.scenes.scene_file import open_scene
from beamline.storage.readers.open import open_scan
from simulators.devices.clock import VirtualClock
from simulators.scenes.expose import Scan


@pytest.mark.parametrize("effects", [["motion_blur", "rolling_shutter"], []])
def test_a_simulated_file_says_what_its_frames_show(tmp_path: Path, effects: list[str]) -> None:
    sizes = ["detector.shape=[4, 16]", "scan.views=6", "scan.darks=1", "scan.flats=1", "phantom.n_particles=5"]
    scene = open_scene("fast_fly", [*sizes, f"effects={effects}"])
    scan = Scan.of(scene.scene)
    write_scan(scene, scan, tmp_path / "scan.h5", lambda _: None, VirtualClock(), lambda: False)
    with open_scan(tmp_path / "scan.h5") as source:
        geometry = geometry_of(source, Selection(), 7.5, source.angles[2:])
        seen, done = Width(arc="auto").rays(source, Selection(), geometry)
        assert source.row_period == pytest.approx(scan.frame(0).shot.row_period if effects else 0)
    moved = math.radians(180) / 6 / scan.period * 0.012
    assert seen.width.arc == pytest.approx(moved if effects else 0)
    assert (done.sentence != "") == bool(effects)
