"""--air: a beam that bends between flats and views, from the simulated scan to the report."""

from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from beamline.projections.corrections.air import Air
from beamline.projections.prepare import DiskBuffer, prepare_projections
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.storage.readers.open import open_scan

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.slow]
SHAPE, VIEWS = (40, 56), 45
SCENE = """
phantom:
  kind: solids
  solids:
    - {kind: ellipsoid, semi_axes: [0.13, 0.13, 0.13], attenuation: 0.15, centre: [0.02, 0.0, -0.02]}
    - {kind: cylinder, radius: 0.1, height: 0.16, attenuation: 5.0, centre: [0.0, 0.0, 0.16]}
beam: {photons_per_s: 1.0e+5}
detector: {shape: [40, 56], pixel_size_um: 12.0, exposure_s: 0.02}
scan: {views: 45, darks: 2, flats: 4}
effects: [BEND, photon_noise, offset]
"""
BEND = "{kind: beam_bend, curvature: [0.06, 0.03], level: -0.06, drift: -2.0e-4}"


def bent_and_straight(scene: str, folder: Path) -> dict[str, Path]:
    """Scans of a scene with and without the effect in place of BEND."""
    found = {}
    for name, effect in (("bent", f"{BEND}, "), ("straight", "")):
        (folder / f"{name}.yaml").write_text(scene.replace("BEND, ", effect), encoding="utf-8")
        found[name] = folder / f"{name}.h5"
        done = CliRunner().invoke(main, ["simulate", str(folder / f"{name}.yaml"), "--out", str(found[name])])
        assert done.exit_code == 0, done.output
    return found


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return bent_and_straight(SCENE, tmp_path_factory.mktemp("air"))


@cache
def _prepared(path: Path, model: str = "auto", buffer: DiskBuffer | None = None) -> PreparedProjections:
    with open_scan(path) as source:
        scan = select(source, Selection(axis_col=27.5, steps=(Air(model),)))
        return prepare_projections(scan, lambda said: None, buffer)


def _recon(scan: Path, output: Path, *options: str) -> tuple[str, str]:
    """What the terminal says, and the record of the volume's file."""
    done = CliRunner().invoke(main, ["recon", str(scan), "--axis", "27.5", "-o", str(output), *options])
    assert done.exit_code == 0, done.output
    with h5py.File(output) as file:
        found: list[str] = []
        file.visititems(lambda name, node: found.append(node[()].decode()) if name.endswith("/background") else None)
    return done.output, found[0]


def test_views_of_a_bent_beam_become_those_of_a_straight_one(scans: dict[str, Path]) -> None:
    bent, straight = (_prepared(scans[name]) for name in ("bent", "straight"))
    assert "subtracted" in bent.origin.done["background"].sentence and straight.origin.done["background"].sentence == ""
    left = bent.seen.data - straight.seen.data
    noise = float(np.std(left[:, :8]))
    assert np.abs(left.mean(axis=0)).max() < 0.01 and noise < 0.02
    as_it_was = _prepared(scans["bent"], "none").seen.data - straight.seen.data
    assert np.abs(as_it_was.mean(axis=0)).max() > 0.04


def test_the_terminal_the_report_and_the_file_say_what_was_taken_off(scans: dict[str, Path], tmp_path: Path) -> None:
    said, record = _recon(scans["bent"], tmp_path / "v.h5", "-m", "fbp")
    assert "Background of the beam subtracted: a polynomial of order" in said and record in said
    page = (tmp_path / "v.html").read_text(encoding="utf-8")
    assert "a polynomial of order" in page.partition("What the metrics mean")[0] and "Air level" in page
    said, record = _recon(scans["bent"], tmp_path / "plain.h5", "-m", "fbp", "--air", "columns", "--no-report")
    assert (
        "Background" not in said
        and record == "no polynomial subtracted, only a straight line through the air at the edges"
    )


def test_slabs_share_the_surface_of_the_whole_to_the_bit(scans: dict[str, Path]) -> None:
    whole = _prepared(scans["bent"])
    buffer = DiskBuffer(np.empty((VIEWS, *SHAPE), np.float32), 7)
    parts = _prepared(scans["bent"], buffer=buffer)
    np.testing.assert_array_equal(parts.seen.data, whole.seen.data)
    assert parts.origin.done["background"].sentence == whole.origin.done["background"].sentence
