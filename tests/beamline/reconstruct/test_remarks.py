"""Remarks that speak against a volume name frames and pixels of the file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.reconstruct.options import OutputPaths
from beamline.reconstruct.scan_facts import MadeVolume, ReportContext, ScanFacts
from beamline.reconstruct.volume_checks import check_volume, not_begun_warning
from drivers.base.clock import SystemClock
from recon.base.geometry import Geometry
from recon.base.method import Ending, Reconstruction
from recon.base.volume import Grid, Volume
from recon.judgement import Aspect, judge
from recon.splatting.gaussians import Gaussians
from recon.voxels.projector import project
from tests.beamline.prepared_views import prepared_views

FIRST_FRAME, FIRST_ROW = 20, 30


def _made(
    rng: np.random.Generator, specks: dict[int, float], method: str
) -> tuple[Reconstruction, PreparedProjections]:
    """A ball in views of which some have a speck in their middle, binned 2 x 2 from rows 30 to 78 of frames 20 on."""
    geometry = Geometry.parallel(np.linspace(0, np.pi, 40, endpoint=False), (24, 48))
    grid = Grid.matching(geometry)
    z, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    volume = Volume((0.05 * (z**2 + y**2 + x**2 < 100)).astype(np.float32), grid)
    data = project(volume, geometry) + rng.normal(0, 0.02, (40, 24, 48)).astype(np.float32)
    for view, height in specks.items():
        data[view, 10:14, 22:26] += height
    prepared = prepared_views(data, geometry)
    lines = replace(prepared.lines, ids=FIRST_FRAME + np.arange(40))
    return Reconstruction(volume, {}, method=method, seconds=1.0), replace(prepared, lines=lines)


def warnings_of(made: Reconstruction, prepared: PreparedProjections, selection: Selection = Selection()) -> list[str]:  # noqa: B008
    """Those of a volume without a report."""
    facts = ScanFacts(Path("scan.h5"), "scan.h5", "", {}, "")
    context, target = ReportContext(facts, selection, "", 0), OutputPaths(Path("out.h5"), None)
    whole = MadeVolume(made, prepared, None, target, context)
    return list(check_volume(whole, lambda event: None, SystemClock()).warnings)


def odd(said: list[str]) -> str:
    """The warning of views, if there is one."""
    return "".join(each for each in said if "differs from the volume by more than" in each)


def test_views_with_a_speck_are_named_with_their_frame_and_its_pixels(rng: np.random.Generator) -> None:
    selection = Selection(rows=(FIRST_ROW, FIRST_ROW + 48), binning=2)
    said = odd(warnings_of(*_made(rng, {7: 0.3, 30: -0.5}, "sirt"), selection))
    assert "a part of 2 projections differs from the volume" in said
    assert "frame 27, rows" in said and "frame 50, rows" in said and said.count("(the projection absorbs less") == 1
    worst = said.split("frame 50, rows ")[1].split(" (")[0].replace(", columns", " ...").split(" ... ")
    first, last, left, right = map(int, worst)
    assert FIRST_ROW + 2 * 10 >= first > FIRST_ROW + 2 * 6 and FIRST_ROW + 2 * 14 <= last + 1 < FIRST_ROW + 2 * 18
    assert 2 * 22 >= left > 2 * 18 and 2 * 26 <= right + 1 < 2 * 30


@pytest.mark.parametrize(("method", "told"), [("sirt", True), ("fbp", False)])
def test_mass_where_views_show_nothing_is_told_and_that_of_a_direct_method_is_not(
    method: str, told: bool, rng: np.random.Generator
) -> None:
    made, prepared = _made(rng, {}, method)
    stray = "of the mass of the SIRT volume lies in voxels that the projections show to be empty"
    assert not any(stray in each for each in warnings_of(made, prepared))
    spoiled = made.volume.data.copy()
    spoiled[:, 2:8, 2:8] += 0.02
    said = warnings_of(replace(made, volume=replace(made.volume, data=spoiled)), prepared)
    assert any(stray in each for each in said) is told


@pytest.mark.parametrize(("width", "told"), [(3.0, False), (0.2, True)])
def test_a_model_of_needles_is_told(width: float, told: bool, rng: np.random.Generator) -> None:
    made, prepared = _made(rng, {}, "r2")
    model = Gaussians.from_physical(np.zeros((5, 3)), np.tile([width, 4.0, width], (5, 1)), np.ones(5))
    said = warnings_of(replace(made, gaussians=model), prepared)
    assert any("100% of the mass is in needle-shaped Gaussians, thinner than a pixel" in each for each in said) is told


def test_no_view_is_named_of_volumes_that_were_stopped_of_direct_methods_and_where_all_are_like_the_volume(
    rng: np.random.Generator,
) -> None:
    made, prepared = _made(rng, {7: 0.5}, "sirt")
    assert odd(warnings_of(made, prepared))
    for other in (replace(made, ending=Ending(early=True)), replace(made, method="fbp")):
        assert not odd(warnings_of(other, prepared))
    assert not odd(warnings_of(*_made(rng, {}, "sirt")))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "wider", "amount", "begun"),
    [("r2", False, 0.0, False), ("r2", True, 1.0, True), ("os-sirt-tv", True, 0.0, False)],
)
def test_a_volume_of_one_density_is_said_to_show_nothing(
    method: str, wider: bool, amount: float, begun: bool, rng: np.random.Generator
) -> None:
    """Whatever method ended before it had begun, and whatever density it began from; also of a sample that is wider
    than the field, of whose views the right volume leaves more than a uniform one."""
    made, prepared = _made(rng, {}, method)
    truth, data = made.volume.data, prepared.seen.data
    if wider:
        around = Volume(np.ones((24, 144, 144), np.float32), replace(made.volume.grid, shape=(24, 144, 144)))
        _, y, x = around.grid.coordinates()
        around.data[:, np.hypot(y[:, None], x) < 24] = 0
        data = data + project(replace(around, data=0.02 * around.data), prepared.geometry)
        prepared = replace(prepared, lines=replace(prepared.lines, data=data))
    blank = np.float32(0.7 * truth.mean())
    volume = replace(made.volume, data=amount * truth + (1 - amount) * blank)
    judgement = judge(volume, prepared.views, aspects=Aspect.RESIDUAL | Aspect.FIT)
    assert (judgement.figures["residual"] > 0.5) is (wider or not begun)
    said = not_begun_warning(replace(made, volume=volume), judgement)
    assert (said == "") is begun
    assert begun or ("does not show the sample yet" in said and "more time, steps or iterations" in said)


def test_the_differences_that_a_uniform_cylinder_leaves_in_closed_form() -> None:
    """Views of that cylinder leave what that very volume leaves; of those of two densities the least squares leave
    their scatter, whatever matter around the field adds to each."""
    made, prepared = _made(np.random.default_rng(0), {}, "sirt")
    grid = made.volume.grid
    _, y, x = np.meshgrid(*grid.coordinates(), indexing="ij")
    full = Volume((np.hypot(y, x) < 24).astype(np.float32), grid)
    shadow = project(full, prepared.geometry)
    factors = np.where(np.arange(40) % 2, 1.5, 0.5).astype(np.float32)[:, None, None]
    some = np.unique(np.linspace(0, 39, 16).round().astype(int))
    f = factors[some, 0, 0]
    scatter = np.sqrt(1 - f.sum() ** 2 / (f.size * (f**2).sum()))
    left = {}
    for name, data in {"one": shadow, "two": factors * shadow, "within others": factors * (shadow + 30)}.items():
        views = replace(prepared, lines=replace(prepared.lines, data=data))
        found = judge(full, views.views, aspects=Aspect.RESIDUAL | Aspect.FIT).along_rows
        assert found is not None
        left[name] = found
    assert left["one"][1] <= left["one"][0] < left["one"][1] + 0.001 and left["one"][0] < 0.02
    assert left["two"][1] == pytest.approx(scatter, abs=0.01)
    assert left["within others"] == pytest.approx(left["two"], abs=1e-4)
