"""A sample wider than the field of view: its measured width, and the volume in a box that contains all of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import recon
from recon.base.method import DataUse, ReconProblem, RunControl
from recon.base.reach import SampleRadius
from recon.base.view_data import Views
from recon.voxels.beyond_field import offset_error, reach_of, whole_reach
from recon.voxels.projector import Projector
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder

COLS, ROWS, VIEWS = 64, 4, 45
ANGLES = np.arange(VIEWS) * np.pi / VIEWS
GEOMETRY = recon.Geometry.parallel(ANGLES, (ROWS, COLS), axis_col=(COLS - 1) / 2)
FIELD = np.hypot(*np.meshgrid(*[np.arange(COLS) - (COLS - 1) / 2] * 2)) < 0.95 * COLS / 2
METHOD = recon.FistaTv(iterations=12, tv_weight=4e-4)


def can(radius: float) -> Phantom:
    """Rods of air and of twice the density in a can, up to its wall."""
    rng = np.random.default_rng(4)
    rods = [Cylinder(radius, 40.0, 0.01)]
    for k in range(40):
        r, turn = (radius - 5) * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
        at = (float(r * np.cos(turn)), float(r * np.sin(turn)), 0.0)
        rods.append(Cylinder(float(rng.uniform(1.5, 4)), 40.0, 0.01 if k % 2 else -0.004, centre=at))
    return Phantom.of(tuple(rods))


def views_of(sample: Phantom, geometry: recon.Geometry = GEOMETRY) -> np.ndarray:
    shots = []
    for angle, (aside, _) in zip(geometry.angles, geometry.shifts, strict=True):
        detector = Detector((ROWS, COLS), 1.0, geometry.axis_col + aside, (ROWS - 1) / 2)
        shots.append(sample.line_integrals(float(angle), detector))
    noise = np.random.default_rng(1).normal(0, 2e-3, (len(shots), ROWS, COLS))
    return (np.stack(shots) + noise).astype(np.float32)


def error(volume: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square error in the field, over the largest density."""
    return float(np.sqrt(np.mean(np.square(volume - truth)[:, FIELD])) / truth.max())


@pytest.fixture(scope="module")
def wide() -> tuple[np.ndarray, np.ndarray]:
    """Views of a can that reaches 1.6 times as far as the field, and its density in the field."""
    sample = can(1.6 * COLS / 2)
    return views_of(sample), sample.attenuation(recon.Grid.matching(GEOMETRY)).astype(np.float32)


@pytest.fixture(scope="module")
def made(wide: tuple[np.ndarray, np.ndarray]) -> recon.Reconstruction:
    return recon.reconstruct(wide[0], GEOMETRY, METHOD)


@pytest.fixture(scope="module")
def found(wide: tuple[np.ndarray, np.ndarray]) -> SampleRadius | None:
    """How far that can reaches, by its views."""
    return whole_reach(Views(wide[0], GEOMETRY)).sample


def test_a_sample_within_the_field_gets_the_volume_of_the_method_to_the_bit() -> None:
    views = views_of(can(0.8 * COLS / 2))
    problem = ReconProblem(Views(views, GEOMETRY), recon.Grid.matching(GEOMETRY))
    made = recon.reconstruct(views, GEOMETRY, METHOD)
    assert np.array_equal(made.volume.data, METHOD.run(problem, RunControl()).volume.data)
    assert made.outside is None and "sample_radius" not in made.settings


def test_the_radius_is_that_of_the_can(found: SampleRadius | None) -> None:
    assert found is not None and found.low <= found.radius <= found.high
    assert 0.88 < found.radius / (1.6 * COLS / 2) < 1.05  # a square as large as the disc has 0.886 of its width
    assert 0 < found.density < 0.1


@pytest.mark.parametrize(("fields", "aside"), [(1.5, 0.0), (2.0, 9.0), (3.0, 0.0)])
def test_the_radius_of_a_homogeneous_cylinder_is_that_of_its_chords(fields: float, aside: float) -> None:
    """Its volume predicts as well in a box of any radius: without the chords, the density was up to twice too large."""
    radius = fields * COLS / 2
    views = Views(views_of(Phantom.of((Cylinder(radius, 40.0, 0.01, centre=(0.0, aside, 0.0)),))), GEOMETRY)
    found = whole_reach(views).sample
    assert found is not None and found.low < found.radius < found.high
    assert found.radius == pytest.approx(radius + aside, rel=0.02)


def test_the_fields_part_is_right_where_a_box_of_the_field_is_far_off(
    wide: tuple[np.ndarray, np.ndarray], made: recon.Reconstruction
) -> None:
    views, truth = wide
    alone = METHOD.run(ReconProblem(Views(views, GEOMETRY), recon.Grid.matching(GEOMETRY)), RunControl())
    by_fbp = recon.reconstruct(views, GEOMETRY, "fbp").volume.data
    assert made.volume.grid == recon.Grid.matching(GEOMETRY)
    assert error(made.volume.data, truth) < 0.9 * error(by_fbp, truth)
    assert error(made.volume.data, truth) < 0.2 * error(alone.volume.data, truth)


def test_volume_and_outside_together_explain_the_views(
    wide: tuple[np.ndarray, np.ndarray], made: recon.Reconstruction
) -> None:
    assert made.outside is not None
    inside = Projector(GEOMETRY, made.volume.grid).forward(np.maximum(made.volume.data, 0))
    left = np.linalg.norm(wide[0] - inside - made.outside(GEOMETRY)) / np.linalg.norm(wide[0])
    assert left < 0.02 < np.linalg.norm(wide[0] - inside) / np.linalg.norm(wide[0])


@pytest.mark.slow
def test_a_given_radius_is_taken(wide: tuple[np.ndarray, np.ndarray]) -> None:
    made = recon.reconstruct(wide[0], GEOMETRY, METHOD, use=DataUse(sample_radius=55.0))
    assert made.settings["sample_radius"] == made.settings["sample_radius_high"] == 55.0
    assert whole_reach(Views(wide[0], GEOMETRY), sample_radius=20.0).sample is None  # within the field
    known = SampleRadius(50.0, 48.0, 53.0, 0.02)
    assert whole_reach(Views(wide[0], GEOMETRY), sample_radius=known).sample is known


@pytest.mark.slow
def test_a_small_grid_holds_what_the_field_holds_there(
    wide: tuple[np.ndarray, np.ndarray], made: recon.Reconstruction
) -> None:
    small = made.volume.grid.part(slice(0, ROWS), slice(20, 40), slice(10, 34))
    part = recon.reconstruct(wide[0], GEOMETRY, METHOD, grid=small).volume.data
    assert np.abs(part - made.volume.data[:, 20:40, 10:34]).max() < 0.1 * made.volume.data.max()


def test_few_views_take_the_end_that_fbp_takes_and_say_that_nothing_is_known() -> None:
    some = GEOMETRY.select(np.arange(0, VIEWS, 4))
    found = whole_reach(Views(views_of(can(1.6 * COLS / 2), some), some)).sample
    assert found is not None and (found.low, found.high, found.density) == (COLS / 2, 4.5 * COLS / 2, 1.0)
    assert found.radius == pytest.approx(1.6 * COLS / 2, rel=0.15)


def test_what_is_open_of_the_density_adds_a_constant_in_the_middle(
    wide: tuple[np.ndarray, np.ndarray], made: recon.Reconstruction, found: SampleRadius | None
) -> None:
    grid = recon.Grid.matching(GEOMETRY)
    y, x = np.meshgrid(*grid.coordinates()[1:], indexing="ij")
    middle = np.hypot(y, x) < COLS / 4
    half = recon.Volume(np.broadcast_to(np.where(middle, 0.5, 9), grid.shape).astype(np.float32), grid)
    assert offset_error(half, GEOMETRY, SampleRadius(40, 38, 42, 0.02)) == pytest.approx(1e-4)
    assert offset_error(half, GEOMETRY, None) == 0
    constant = float((made.volume.data - wide[1])[:, middle].mean()) ** 2
    assert constant < 2 * offset_error(made.volume, GEOMETRY, found)


@pytest.mark.parametrize("given", [-1.0, np.inf])
def test_a_radius_that_is_no_length_is_refused(wide: tuple[np.ndarray, np.ndarray], given: float) -> None:
    with pytest.raises(ValueError, match="sample_radius must be a finite length"):
        recon.reconstruct(wide[0], GEOMETRY, METHOD, use=DataUse(sample_radius=given))


@pytest.mark.slow
def test_wide_views_make_the_density_surer_and_have_no_part_in_fbp(
    wide: tuple[np.ndarray, np.ndarray], found: SampleRadius | None
) -> None:
    aside = 0.9 * COLS
    turns = np.repeat([0, np.pi / 2], 2)
    shifts = np.zeros((VIEWS + 4, 2))
    shifts[VIEWS:, 0] = [-aside, aside] * 2
    both = recon.Geometry.parallel(
        np.concatenate((ANGLES, turns)), (ROWS, COLS), axis_col=GEOMETRY.axis_col, shifts=shifts
    )
    assert both.reach == GEOMETRY.reach and both.is_centred.sum() == VIEWS
    views = np.concatenate((wide[0], views_of(can(1.6 * COLS / 2), both.select(np.arange(VIEWS, VIEWS + 4)))))
    seen = whole_reach(Views(views, both)).sample
    assert found is not None and seen is not None and seen.density < 0.8 * found.density
    assert 0.88 < seen.radius / (1.6 * COLS / 2) < 1.05
    fbp = [recon.reconstruct(data, each, "fbp").volume.data for data, each in ((views, both), (wide[0], GEOMETRY))]
    assert np.array_equal(fbp[0], fbp[1])


@pytest.mark.parametrize("off", [(0.0, 0.0), (3.5, -7.25)])
def test_a_box_that_reaches_farther_keeps_its_voxels(off: tuple[float, float]) -> None:
    box = recon.Grid((3, 20, 31), 0.5, (1.0, *off))
    wider = box.reaching(12.3, GEOMETRY)
    inside = [np.flatnonzero(np.isclose(wider.coordinates()[k], box.coordinates()[k][0]))[0] for k in (1, 2)]
    for axis, first in zip((1, 2), inside, strict=True):
        assert np.allclose(wider.coordinates()[axis][first:][: box.shape[axis]], box.coordinates()[axis])
    assert (np.abs(wider.edges[:, :2]) >= 12.3 - 1e-9).all() and wider.shape[0] == 3
    assert box.reaching(1.0, GEOMETRY).shape[1:] >= box.shape[1:]


def test_a_box_ends_before_the_source_of_a_cone() -> None:
    cone = recon.Geometry.cone(ANGLES, (8, 32), 1.0, 60.0, 90.0)
    wider = recon.Grid.matching(cone).reaching(500.0, cone)
    assert np.hypot(*wider.edges[1, :2]) + wider.voxel_size / 2 < cone.source_distance


@pytest.mark.slow
def test_matter_above_and_below_the_field_of_a_cone_stays_out_of_its_slices() -> None:
    """A rod with discs across goes on for twice the height that rows see; the same rod within is not touched."""
    turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    cone = recon.Geometry.cone(turn, (16, 48), 1.0, 80.0, 80.0)
    grid, tall = recon.Grid.matching(cone), recon.Grid((48, 48, 48), 1.0)
    z, y, x = np.meshgrid(*tall.coordinates(), indexing="ij")
    rod = np.where(np.hypot(x, y) < 14, 0.01 + 0.01 * (np.sin(z) > 0), 0).astype(np.float32)
    inner = slice(16, 32)
    views = Projector(cone, tall).forward(rod)
    problem = ReconProblem(Views(views, cone), grid)
    made, alone = recon.reconstruct(views, cone, METHOD), METHOD.run(problem, RunControl())
    assert made.volume.grid == grid and made.outside is not None

    def off(volume: np.ndarray) -> float:
        return float(np.sqrt(np.mean((volume - rod[inner]) ** 2)))

    assert off(made.volume.data) < 0.5 * off(alone.volume.data)
    left = views - made.outside(cone) - Projector(cone, grid).forward(made.volume.data)
    assert np.abs(left).mean() < 0.02 * views.mean()
    rod[: inner.start + 3], rod[inner.stop - 3 :] = 0, 0
    views = Projector(cone, tall).forward(rod)
    assert recon.reconstruct(views, cone, METHOD).outside is None


def test_a_sample_that_ends_within_the_heights_of_a_helix_is_not_taken_for_a_taller_one() -> None:
    turn = np.linspace(0, 4 * np.pi, 40, endpoint=False)
    shifts = np.stack((np.zeros(40), np.linspace(-20, 20, 40)), 1)
    helix, tall = recon.Geometry.cone(turn, (16, 48), 1.0, 80.0, 80.0, shifts=shifts), recon.Grid((64, 48, 48), 1.0)
    z, y, x = np.meshgrid(*tall.coordinates(), indexing="ij")
    rod = np.where(np.hypot(x, y) < 14, 0.01, 0).astype(np.float32)
    for low, high, goes_on in ((-16, 16, False), (-32, 16, True), (-16, 32, True)):
        views = Projector(helix, tall).forward(np.where((z > low) & (z < high), rod, 0).astype(np.float32))
        assert reach_of(Views(views, helix)).tall == goes_on


def test_a_fan_sees_nothing_above_or_below_its_row() -> None:
    """One row ends in matter at both edges: three slices in place of one would take another kernel, at ten times the
    time."""
    fan = recon.Geometry.fan(np.linspace(0, 2 * np.pi, 24, endpoint=False), 24, 1.0, 60.0, 90.0)
    box = recon.Grid.matching(fan)
    y, x = np.meshgrid(*box.coordinates()[1:], indexing="ij")
    views = Projector(fan, box).forward(np.where(np.hypot(y, x) < 5, 0.1, 0).astype(np.float32)[None])
    assert not reach_of(Views(views, fan)).tall
    aside = replace(fan, axis_row=4.0)  # its rays climb
    assert fan.is_fan and not aside.is_fan and reach_of(Views(views, aside)).tall
