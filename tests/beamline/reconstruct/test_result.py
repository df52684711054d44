"""What is delivered beside a volume: the direct reconstruction of the same views, by the method that takes them."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

import recon
from beamline.core.errors import DataError
from beamline.core.events import Event
from beamline.page.tiles import TileRegion
from beamline.page.volume import ShownVolume
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.reconstruct.options import OutputPaths
from beamline.reconstruct.outcome import ReportContext, facts_of
from beamline.reconstruct.result import write_result
from beamline.report import figures
from beamline.storage.readers.open import SourceOptions
from beamline.storage.writers.recon_file import read_reconstruction
from drivers.base.clock import SystemClock
from recon.base.geometry import Geometry
from recon.base.method import Reconstruction
from recon.base.volume import Grid, Volume
from recon.voxels.direct import direct
from recon.voxels.projector import Projector
from tests.beamline.scans import TwoCylinders, write_exchange

pytestmark = pytest.mark.usefixtures("one_thread")

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(6, 40))


def _scan(folder: Path, turn: float) -> tuple[PreparedProjections, ReportContext]:
    """A file's context, with a cone's views of the same sample (magnified five times) in place of its own."""
    write_exchange(folder / "scan.h5", SCAN)
    with SourceOptions(folder / "scan.h5").open() as source:
        facts = facts_of(source)
        selection = Selection(axis_col=SCAN.axis_col)
        prepared = prepare_projections(source, selection, lambda said: None)
    angles = np.linspace(0, turn, 30, endpoint=False)
    cone = Geometry.cone(angles, SCAN.shape, 5.0, 400.0, 2000.0, axis_col=SCAN.axis_col)
    grid = Grid.matching(cone)
    data = Projector(cone, grid).forward(SCAN.truth(grid))
    views = replace(prepared, projections=replace(prepared.projections, data=data), geometry=cone, held_out=None)
    return views, ReportContext(facts, selection, "beamline recon scan.h5", 0)


@pytest.mark.parametrize(("turn", "compared"), [(2 * np.pi, True), (3.6, True), (2.8, False)])
def test_a_cones_volume_is_compared_with_fdk_where_there_is_one(tmp_path: Path, turn: float, compared: bool) -> None:
    prepared, context = _scan(tmp_path, turn)
    result = recon.reconstruct(prepared.projections.data, prepared.geometry, recon.OsSirtTv(iterations=3))
    events: list[Event] = []
    write_result(
        result,
        prepared,
        None,
        OutputPaths(tmp_path / "out.h5", tmp_path / "out.html"),
        context,
        events.append,
        SystemClock(),
    )
    done = events[-1].data
    assert ("fbp" in done) is compared
    if compared:
        assert done["fbp"]["residual"] < 0.3
    assert (tmp_path / "out.html").exists()


@pytest.mark.parametrize("doubtful", [True, False])
def test_fbp_is_kept_beside_a_volume_that_hides_something(tmp_path: Path, doubtful: bool) -> None:
    scan = replace(SCAN, shape=(12, 40))
    write_exchange(tmp_path / "scan.h5", scan)
    with SourceOptions(tmp_path / "scan.h5").open() as source:
        facts, selection = facts_of(source), Selection(axis_col=SCAN.axis_col)
        prepared = prepare_projections(source, selection, lambda said: None)
    volume = recon.reconstruct(prepared.projections.data, prepared.geometry, recon.FistaTv(iterations=15)).volume
    if doubtful:
        volume = replace(volume, data=gaussian_filter(volume.data, (0, 2, 2)))
    events: list[Event] = []
    target = OutputPaths(tmp_path / "out.h5", tmp_path / "out.html")
    made = Reconstruction(volume, {}, method="fista-tv", seconds=1.0)
    context = ReportContext(facts, selection, "beamline recon scan.h5", 0)
    write_result(made, prepared, None, target, context, events.append, SystemClock())
    record = read_reconstruction(target.output)
    np.testing.assert_array_equal(record.volume.data, volume.data)
    said = [str(event.data.get("message")) for event in events]
    assert any("`beamline view out.h5` shows both" in each for each in said) is doubtful
    with closing(ShownVolume(target.output)) as shown:
        assert shown.has_fbp is doubtful is (record.fbp is not None)
    if record.fbp is None:
        with pytest.raises(DataError, match="keeps no FBP"):
            ShownVolume(target.output, fbp=True)
        return
    expected = direct(prepared.projections.data, prepared.geometry, volume.grid, "hann")
    np.testing.assert_allclose(record.fbp, expected, atol=1e-6)
    with closing(ShownVolume(target.output, fbp=True)) as fbp:
        assert fbp.facts()["name"] == "out.h5, FBP"
        np.testing.assert_array_equal(fbp.cut(0, 5, TileRegion(0, 40, 0, 40)).values, record.fbp[5])


def test_fbp_that_another_format_cannot_keep_is_told(tmp_path: Path) -> None:
    write_exchange(tmp_path / "scan.h5", replace(SCAN, shape=(12, 40)))
    with SourceOptions(tmp_path / "scan.h5").open() as source:
        facts, selection = facts_of(source), Selection(axis_col=SCAN.axis_col)
        prepared = prepare_projections(source, selection, lambda said: None)
    grid = Grid.matching(prepared.geometry)
    sharp = direct(prepared.projections.data, prepared.geometry, grid, "hann")
    made = Reconstruction(Volume(gaussian_filter(sharp, (0, 2, 2)), grid), {}, method="fista-tv", seconds=1.0)
    events: list[Event] = []
    target = OutputPaths(tmp_path / "out.npy", tmp_path / "out.html")
    context = ReportContext(facts, selection, "beamline recon scan.h5", 0)
    write_result(made, prepared, None, target, context, events.append, SystemClock())
    said = [str(event.data.get("message")) for event in events]
    assert any("may hide" in each for each in said)
    assert any("FBP of the same views is not kept" in each and "--method fbp" in each for each in said)


def test_a_view_is_drawn_as_large_as_it_is_at_the_axis(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(figures, "png", lambda figure: drawn.append(figure) or b"")
    for geometry in (
        Geometry.parallel([0.0, 1.0], (6, 40), pixel_pitch=0.5, axis_col=18.0),
        Geometry.cone([0.0, 1.0], (6, 40), 5.0, 100.0, 1000.0, axis_col=18.0),
    ):
        figures.projection(np.random.default_rng(0).random((2, 6, 40), np.float32), geometry, 0, "mm")
    flat, cone = (figure.axes[0].get_images()[0].get_extent() for figure in drawn)
    np.testing.assert_allclose(cone, flat)
    np.testing.assert_allclose(flat, [-18.5 * 0.5, 21.5 * 0.5, 1.5, -1.5])  # z downwards
