"""A scan of a cone beam, from its file to a volume: distances are kept, rows and bins keep the central ray."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.monitor.digest import digest
from beamline.page.shown_scan import ShownScan
from beamline.page.tiles import TileRegion
from beamline.projections.corrections.air import Air
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.reconstruct import estimate
from beamline.storage.readers.open import open_scan
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame, FrameKind
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.direct import fdk
from tests.beamline.cli.small_scan import beamline

SOD, SDD, PITCH, SHAPE, AXIS = 40.0, 60.0, 0.03, (40, 48), 22.5
BALL, CENTRE, MU = 0.2, (0.12, -0.05, 0.06), 1.5  # mm, (x, y, z), 1/mm
INFO = ScanInfo(
    sample="ball", pixel_size_mm=PITCH, distance_mm=SDD - SOD, source_distance_mm=SOD, axis_col=AXIS
)  # fmt: skip
PLAIN = Selection(steps=(Air("none"),))


def _line_integrals(angle: float) -> NDArray[np.float64]:
    """A ball seen from a point: 2 μ √(r² - d²) with d the distance of its centre from the ray through each pixel."""
    rows, cols = SHAPE
    u, v = (np.arange(cols) - AXIS) * PITCH, (np.arange(rows) - (rows - 1) / 2) * PITCH
    ray = np.stack(np.broadcast_arrays(u[None, :], SDD, v[:, None]), axis=-1)  # from the source, in (u, beam, v)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    x, y, z = CENTRE
    c, s = np.cos(angle), np.sin(angle)
    ball = np.array([x * c + y * s, SOD + y * c - x * s, z])
    distance2 = ball @ ball - (ray @ ball) ** 2
    return 2 * MU * np.sqrt(np.clip(BALL**2 - distance2, 0, None))


def _write(path: Path, info: ScanInfo, views: int = 90) -> None:
    angles = 2 * np.pi * np.arange(views) / views
    frames = [np.zeros(SHAPE), np.full(SHAPE, 50_000.0), *(50_000 * np.exp(-_line_integrals(a)) for a in angles)]
    kinds = [FrameKind.DARK, FrameKind.FLAT, *[FrameKind.PROJECTION] * views]
    with NXtomoWriter(path, info, SHAPE, clock=SystemClock()) as writer:
        for i, (frame, kind) in enumerate(zip(frames, kinds, strict=True)):
            counts = np.rint(frame).astype(np.uint16)
            angle = angles[i - 2] if i > 1 else np.nan
            writer.append(Frame(counts, kind, i, i, i, angle, 0.1 * i, 0.05), digest(counts, 65535, 4))


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cone") / "ball.h5"
    _write(path, INFO)
    return path


def _never(message: str) -> None:
    raise AssertionError(message)


def test_a_cone_beam_file_gives_back_its_geometry_and_its_sample(scan: Path) -> None:
    with open_scan(scan) as source:
        assert source.cone == (SOD, SDD)
        prepared = prepare_projections(select(source, replace(PLAIN, axis_col=AXIS)), _never)
    geometry = prepared.geometry
    assert (geometry.sod, geometry.sdd, geometry.axis_col, geometry.pixel_pitch) == (SOD, SDD, AXIS, PITCH)
    assert geometry.period == pytest.approx(2 * np.pi)
    grid = Grid.matching(geometry)
    volume = fdk(prepared.seen.data, geometry, grid, "hann")
    z, y, x = grid.coordinates()
    inside = ((z[:, None, None] - CENTRE[2]) ** 2 + (y[:, None] - CENTRE[1]) ** 2 + (x - CENTRE[0]) ** 2) < 0.12**2
    assert volume[inside].mean() == pytest.approx(MU, rel=0.03)
    weights = np.clip(volume, 0.3 * MU, None) - 0.3 * MU  # the streaks between few views are far below that
    for axis, expected in ((x, CENTRE[0]), (y[:, None], CENTRE[1]), (z[:, None, None], CENTRE[2])):
        assert (weights * axis).sum() / weights.sum() == pytest.approx(expected, abs=0.1 * grid.voxel_size)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stated", "told"),
    [(AXIS - 2.3, ["agree better with this column than with the file's column 20.20"]), (None, []), (AXIS, [])],
)
def test_an_axis_is_found_or_kept_by_views_held_out(tmp_path: Path, stated: float | None, told: list[str]) -> None:
    path, warnings = tmp_path / "axis.h5", list[str]()
    _write(path, replace(INFO, axis_col=stated), views=24)
    with open_scan(path) as source:
        prepared = prepare_projections(select(source, PLAIN), warnings.append)
        given = prepare_projections(select(source, replace(PLAIN, axis_col=20.2)), _never)
    assert prepared.origin.axis_col == pytest.approx(AXIS, abs=0.05)
    assert stated == AXIS or (prepared.origin.axis is not None and prepared.origin.axis.confident)
    assert given.origin.axis_col == 20.2
    assert len(warnings) == len(told) and all(words in warning for words, warning in zip(told, warnings, strict=True))


def test_rows_and_bins_keep_the_central_ray(scan: Path) -> None:
    with open_scan(scan) as source:
        given = replace(PLAIN, axis_col=AXIS)  # it is not searched for
        whole = prepare_projections(select(source, given), _never).geometry
        rows = prepare_projections(select(source, replace(given, rows=(10, 30), binning=2)), _never).geometry
    assert rows.detector_shape == (10, 24)
    # The central ray met row 19.5 of the detector: 9.5 of the rows that are read, 4.5 of these in pairs.
    assert (whole.axis_row, rows.axis_row) == (19.5, pytest.approx(4.5))
    assert (rows.pixel_pitch, rows.sdd) == (2 * PITCH, SDD)


def test_a_file_that_does_not_say_so_is_made_a_cone_by_words(tmp_path: Path) -> None:
    path = tmp_path / "silent.h5"
    _write(path, replace(INFO, source_distance_mm=None), views=8)
    with open_scan(path) as source:
        assert source.cone is None  # a detector's distance alone is propagation in a parallel beam
        told = replace(PLAIN, cone=(SOD, SDD))
        assert prepare_projections(select(source, told), _never).geometry.is_cone


def test_a_row_of_a_cone_is_shown_as_a_slice_at_its_height(scan: Path) -> None:
    row = 24
    with closing(ShownScan(open_scan(scan))) as shown:
        assert shown.axis(row) == {"axis": AXIS, "said": "from the file", "leans": False}
        tile = shown.fbp(row, AXIS, 0.0, TileRegion(0, 99, 0, 99), fast=False)
    step = PITCH * SOD / SDD
    z = (row - (SHAPE[0] - 1) / 2) * step
    radius = np.sqrt(BALL**2 - (z - CENTRE[2]) ** 2)
    y, x = ((np.arange(n) - (n - 1) / 2) * step for n in tile.values.shape)
    inside = np.hypot(x[None] - CENTRE[0], y[:, None] - CENTRE[1]) < radius
    assert tile.values[inside].mean() == pytest.approx(MU, rel=0.1)
    assert tile.values.sum() == pytest.approx(MU * inside.sum(), rel=0.1)


def test_a_dry_run_knows_a_cone_and_refuses_one_that_no_slab_would_make_fit(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = list[tuple[Geometry, Grid]]()
    monkeypatch.setattr(estimate, "forecast", lambda method, geometry, grid, now: seen.append((geometry, grid)))
    found = beamline("recon", str(scan), "-m", "sirt", "-o", str(tmp_path / "out.h5"), "--dry-run")
    assert found.exit_code == 0 and "40 x 48 x 48 voxels with sirt, from 90 projections" in found.stdout, found.output
    geometry = seen[0][0]
    assert (geometry.sod, geometry.sdd, geometry.axis_col, geometry.pixel_pitch) == (SOD, SDD, AXIS, PITCH)
    for words in (("--dry-run",), ()):
        small = beamline("recon", str(scan), "-o", str(tmp_path / "out.h5"), "--memory", "1M", *words)
        assert small.exit_code == 5 and "a cone-beam volume cannot be made in slabs" in small.stderr
