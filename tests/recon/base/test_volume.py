"""The box of a fit contains everything that projections see, however they are shifted."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.base.geometry import Geometry
from recon.base.method import Reconstruction
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.reconstruction import reconstruct
from recon.splatting.gaussians import Gaussians
from recon.splatting.initialise import first_volume, place
from recon.splatting.r2 import R2
from recon.splatting.settings import FitSettings
from recon.splatting.splat import project, voxelize
from recon.voxels.projector import Projector
from tests.messages import refused
from tests.recon.trigonometry import pixel_of
from tests.slow_cases import others_slow

TURN = np.linspace(0, 2 * np.pi, 48, endpoint=False)


def _sample(width: float, height: float, seed: int = 0) -> Gaussians:
    """Blobs of a fit's kernel in a cylinder of this radius and half height, one of them at its rim."""
    rng = np.random.default_rng(seed)
    angle, radius = rng.uniform(0, 2 * np.pi, 25), width * np.sqrt(rng.uniform(0, 1, 25))
    radius[0] = width
    means = np.stack((radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-height, height, 25)), 1)
    densities = rng.uniform(0.05, 0.1, 25)
    return Gaussians.from_physical(means, np.full((25, 3), 1.5), densities, kernel=FitSettings().kernel)


def _fitted(data: np.ndarray, views: Geometry, grid: Grid | None = None) -> Reconstruction:
    return reconstruct(data, views, R2(steps=60, gaussians=600, finish=0), grid=grid)


def test_a_shift_of_all_views_is_fitted_like_a_moved_axis() -> None:
    # A detector beside the axis sees one half of the sample at a time.
    moved = Geometry.parallel(TURN, (10, 32), axis_col=29.5)
    shifted = Geometry.parallel(TURN, (10, 32), shifts=np.tile([14.0, 0.0], (48, 1)))
    data, same = (project(_sample(24.0, 3.0), views).numpy() for views in (moved, shifted))
    np.testing.assert_allclose(same, data, atol=1e-5 * data.max())
    grid = Grid((10, 60, 60))
    one, other = (_fitted(data, views, grid) for views in (moved, shifted))
    np.testing.assert_allclose(other.volume.data, one.volume.data, atol=1e-3 * float(one.volume.data.max()))
    assert other.history[-1].residual < 0.2


def test_views_that_jump_along_the_axis_find_all_matter() -> None:
    # Ten rows that see the lower half of a sample of twenty in one view, the upper half in the next, and no middle.
    jumps = np.stack((np.zeros(48), np.where(np.arange(48) % 2, 10.0, -10.0)), 1)
    views = Geometry.parallel(TURN, (10, 32), shifts=jumps)
    sample = _sample(9.0, 3.0)
    means = np.concatenate([sample.means.numpy() + np.array([0, 0, z], np.float32) for z in (-10.0, 10.0)])
    both = Gaussians.from_physical(means, np.full((50, 3), 1.5), np.tile(sample.densities.double().numpy(), 2))
    field = Grid.of_field(views, 1.0)
    assert field == Grid((30, 32, 32))
    data = project(both, views).numpy()
    placed = place(first_volume(data, views, field), Views(data, views), 600, np.random.default_rng(0))
    heights = placed.means.numpy()[:, 2]
    assert (heights < -5).mean() > 0.35 and (heights > 5).mean() > 0.35
    found = _fitted(project(both, views).numpy(), views, field).volume.data.sum(axis=(1, 2))
    expected = voxelize(both, field).numpy().sum(axis=(1, 2))
    for half in (slice(0, 10), slice(20, 30)):
        assert found[half].sum() == pytest.approx(expected[half].sum(), rel=0.15)


def _shifted(*shifts: tuple[float, float]) -> Geometry:
    """Views of 10 x 32 pixels of half a millimetre, shifted like these (col, row) in turn."""
    return Geometry.parallel(TURN, (10, 32), pixel_pitch=0.5, shifts=np.resize(np.array(shifts), (48, 2)))


def test_a_shift_of_all_views_moves_the_matching_volume_as_the_axis_row_does() -> None:
    explicit = Geometry.parallel(TURN, (10, 32), pixel_pitch=0.5, axis_col=15.5 + 14.0, axis_row=11.5)
    found = Grid.matching(_shifted((14.0, 7.0)))
    assert found == Grid.matching(explicit)
    assert found.centre[0] == pytest.approx(Grid.for_fit(_shifted((0.0, 7.0)), found).centre[0])


def test_the_matching_volume_holds_what_views_that_jump_see() -> None:
    up_and_down, sideways = _shifted((0.0, 10.0), (0.0, -10.0)), _shifted((16.0, 0.0), (-16.0, 0.0))
    for views, shape in ((up_and_down, (30, 32, 32)), (sideways, (10, 64, 64))):
        assert Grid.matching(views).shape == shape
        assert Grid.matching(views) == Grid.for_fit(views, Grid.matching(views))
    uneven = Grid.matching(_shifted((0.0, 3.0), (0.0, 3.0), (0.0, 3.0), (0.0, 9.0)))  # a quarter sees six rows more
    assert uneven.shape == (10, 32, 32) and uneven.centre[0] == pytest.approx(-1.5)


def test_small_shifts_leave_the_matching_volume_the_size_of_the_detector() -> None:
    jitter = np.random.default_rng(0).uniform(-1.5, 1.5, (48, 2))
    views = Geometry.parallel(TURN, (10, 32), shifts=jitter)
    volume = Grid.matching(views)
    assert volume.shape == (10, 32, 32) and abs(volume.centre[0]) < 0.5
    box = Grid.for_fit(views, volume)
    assert (box.edges[0] <= volume.edges[0]).all() and (volume.edges[1] <= box.edges[1]).all()


def test_a_fit_of_a_wider_sample_gets_a_wider_box() -> None:
    grid = Grid((10, 30, 30))
    views = Geometry.parallel(TURN, (10, 30))
    assert Grid.for_fit(views, grid.reaching(18, views), wider=True) == Grid((10, 36, 36))
    assert Grid.for_fit(views, grid.reaching(18, views)) == Grid.for_fit(views, grid)
    near = Geometry.cone(TURN, (10, 30), 1.0, 23.0, 23.0)
    field, box = Grid.for_fit(near, grid), Grid.for_fit(near, grid.reaching(18, near), wider=True)
    assert field.shape[1] < box.shape[1] < 36 and np.hypot(*box.edges[1][:2]) < near.sod


@pytest.mark.parametrize("axis_row", [5.5, -4.0, 20.0])
def test_the_rays_of_a_cone_meet_all_slices_of_its_tall_box_and_no_others(axis_row: float) -> None:
    views = Geometry.cone(TURN, (12, 40), 1.0, 90.0, 90.0, axis_row=axis_row)
    grid = Grid.matching(views)
    tall = grid.as_tall_as_rays(views)
    added = np.rint(np.subtract(grid.first, tall.first)[0]).astype(int)
    assert tall.shape[1:] == grid.shape[1:] and tall.shape[0] >= added + grid.shape[0] >= grid.shape[0]
    more = Grid((tall.shape[0] + 8, *tall.shape[1:]), 1.0, tall.centre)
    slices = np.zeros(more.shape, np.float32)
    for k in (3, more.shape[0] - 4):
        slices[k] = 1
    assert not Projector(views, more).forward(slices).any()
    slices[:] = 0
    slices[5 if axis_row > 0 else -6] = 1
    assert Projector(views, more).forward(slices).any()
    straight = Geometry.parallel(TURN, (12, 40))
    assert Grid.matching(straight).as_tall_as_rays(straight) == Grid.matching(straight)


def test_the_tall_box_of_a_helix_holds_rays_that_climb_from_a_source_which_climbs_too() -> None:
    still = Geometry.cone(TURN, (12, 40), 1.0, 90.0, 90.0)
    centres = np.zeros((TURN.size, 3))
    centres[:, 2] = np.linspace(-60, 60, TURN.size)
    helix = still.about(centres)
    of_one, of_all = (Grid.matching(views).as_tall_as_rays(views).shape[0] for views in (still, helix))
    assert of_all == Grid.matching(helix).shape[0] + of_one - Grid.matching(still).shape[0]


def test_a_volume_of_no_stated_size_shows_all_heights_that_jumping_views_see() -> None:
    views = Geometry.parallel(TURN, (10, 32), shifts=np.resize([[0.0, 10.0], [0.0, -10.0]], (48, 2)))
    result = reconstruct(project(_sample(9.0, 12.0), views).numpy(), views, "fbp")
    planes = np.abs(result.volume.data).sum(axis=(1, 2))
    assert result.volume.grid.shape[0] == 30 and (planes[:10] > 0).all() and (planes[20:] > 0).all()


def test_an_axis_beyond_the_detector_is_no_end_of_the_field() -> None:
    views = Geometry.parallel(TURN, (6, 48), axis_col=-20.0)  # sees what lies 19.5 to 67.5 pixels from the axis
    ring = Gaussians.from_physical([[59.0, 11.0, 0.0], [-50.0, -33.0, 0.5]], np.full((2, 3), 2.0), [0.1, 0.1])
    data = project(ring, views).numpy()
    field = Grid.of_field(views, 1.0)
    placed = place(first_volume(data, views, field), Views(data, views), 300, np.random.default_rng(0))
    near = np.linalg.norm(placed.means.numpy()[:, None] - ring.means.numpy()[None], axis=2).min(axis=1)
    assert (near < 6).mean() > 0.3  # the others are on streaks: each point is seen from a third of the circle


@pytest.mark.parametrize("edge", [1.0, 2.0, 32.0])
def test_a_box_of_any_size_and_voxels_holds_what_the_whole_volume_holds_there(edge: float) -> None:
    # The fit is that of voxels from one to four pixels wherever they are wanted: four for those of thirty-two.
    views = Geometry.parallel(TURN[::2] / 2, (16, 32))
    data = project(_sample(9.0, 5.0), views).numpy()
    whole = Grid((16, 32, 32), 1.0)
    small = Grid((2, 2, 2), edge, centre=(0.5, 2.5, -1.5))
    like = _fitted(data, views, Grid((4, 8, 8), min(edge, 4.0)))
    found = _fitted(data, views, small)
    assert found.gaussians is not None and like.gaussians is not None
    np.testing.assert_array_equal(found.gaussians.means.numpy(), like.gaussians.means.numpy())
    fine = max(edge**2 - 1, 1e-6) ** 0.5 / 32  # rays without width: Gaussians hold the pixel's own mean
    boxes = [Grid((32, 32, 32), fine, centre) for centre in itertools.product(*small.coordinates())]
    means = [voxelize(found.gaussians, box).numpy().mean() for box in boxes]
    most = voxelize(found.gaussians, whole).numpy().max()
    assert np.sqrt(np.square(found.volume.data.ravel() - means).mean()) < 0.01 * most
    assert found.history[-1].residual < 0.2


@pytest.mark.parametrize("turn", others_slow([TURN, 0.7 * TURN]))
def test_a_cone_too_wide_for_a_box_of_its_pixels_is_fitted(turn: np.ndarray) -> None:
    # The detector's half width at the axis is 20 mm, and so far away is the source, but for 2 mm.
    views = Geometry.cone(turn, (9, 40), 2.0, 22.0, 44.0)
    data = project(_sample(9.0, 2.0), views).numpy()
    result = _fitted(data, views, Grid((9, 24, 24)))
    assert result.history[-1].residual < 0.3


def test_what_cannot_be_joined_is_told_before_anything_is_placed() -> None:
    views = Geometry.parallel(TURN, (1, 32))
    with refused(ValueError):
        reconstruct(np.zeros((48, 1, 32)), views, R2(steps=5, fit=FitSettings(joined_pixels=2)))


def test_a_volume_is_saved_with_its_places_and_nothing_is_overwritten(tmp_path: Path) -> None:
    grid = Grid((2, 3, 4), 0.5, (1.0, 2.0, 3.0), slice_pitch=0.25)
    volume = Volume(np.arange(24, dtype=np.float32).reshape(grid.shape), grid)
    volume.save(tmp_path / "v.npz", method="r2")
    with np.load(tmp_path / "v.npz", allow_pickle=False) as saved:
        np.testing.assert_array_equal(saved["volume"], volume.data)
        assert (float(saved["voxel_mm"]), float(saved["slice_mm"]), str(saved["method"])) == (0.5, 0.25, "r2")
        assert tuple(saved["centre_zyx_mm"]) == grid.centre
    loaded = Reconstruction.load(tmp_path / "v.npz")
    np.testing.assert_array_equal(loaded.volume.data, volume.data)
    assert (loaded.volume.grid, loaded.volume.data.dtype) == (grid, np.float32)
    assert (loaded.method, loaded.settings) == ("r2", {})
    with refused(FileExistsError):
        volume.save(tmp_path / "v.npz")
    with refused(ValueError):
        volume.save(tmp_path / "v.tif")
    assert [path.name for path in tmp_path.iterdir()] == ["v.npz"]


def test_the_edges_are_half_a_voxel_beyond_the_centres() -> None:
    grid = Grid((3, 4, 5), 0.5, centre=(1.0, 2.0, 3.0))
    low, high = grid.edges
    for axis, centres in zip((2, 1, 0), grid.coordinates(), strict=True):
        assert (low[axis], high[axis]) == pytest.approx((centres[0] - 0.25, centres[-1] + 0.25))


def test_the_field_of_a_centred_axis_is_the_matching_grid() -> None:
    for cols, pitch in ((7, 0.1), (160, 0.0046), (2048, 1.0)):
        views = Geometry.parallel([0.0], (5, cols), pixel_pitch=pitch)
        assert Grid.of_field(views, pitch) == Grid.matching(views)


def test_a_grid_takes_any_list_of_whole_numbers() -> None:
    assert Grid([2, 3, 4], centre=np.zeros(3)) == Grid((2, 3, 4))  # type: ignore[arg-type]
    for arguments, message in (
        ({"shape": (2.5, 3, 4)}, "3 values, each a whole number"),
        ({"shape": (0, 3, 4)}, "shape"), ({"voxel_size": 0.0}, "voxel_size"), ({"centre": (0, np.nan, 0)}, "centre"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            Grid(**({"shape": (2, 3, 4)} | arguments))


def test_a_volume_fits_its_grid() -> None:
    with refused(ValueError):
        Volume(np.zeros((2, 2, 2), np.float32), Grid((2, 2, 3)))


def _edges(geometry: Geometry, view: int) -> np.ndarray:
    """u and z in mm [2, 2] at which the first and last edge of a view's columns and rows see the plane of the axis.

    From where three points of that plane fall, so from nothing but trigonometry: pixels are linear in u and z there.
    """
    c, s = np.cos(geometry.angles[view]), np.sin(geometry.angles[view])
    middle, right, up = (pixel_of(geometry, view, np.array(p)) for p in ((0.0, 0.0, 0.0), (c, s, 0.0), (0.0, 0.0, 1.0)))
    rows, cols = geometry.detector_shape
    u = (np.array([-0.5, cols - 0.5]) - middle[0]) / (right - middle)[0]
    z = (np.array([-0.5, rows - 0.5]) - middle[1]) / (up - middle)[1]
    return np.stack((u, z))


moves = st.lists(st.tuples(st.floats(-0.5, 0.5), st.floats(-30, 30)), min_size=1, max_size=4)


@given(
    rows=st.integers(1, 9), cols=st.integers(1, 40), axis=st.tuples(st.floats(-60, 60), st.floats(-20, 20)),
    pitch=st.floats(1e-3, 1e3), coarser=st.floats(1, 5), shifts=moves, cone=st.booleans(),
)  # fmt: skip
def test_the_field_holds_every_ray_and_no_more(
    rows: int, cols: int, axis: tuple[float, float], pitch: float, coarser: float,
    shifts: list[tuple[float, float]], cone: bool,
) -> None:  # fmt: skip
    shifts = [(col * cols / 2, row) for col, row in shifts]  # farther aside would be offset views
    angles = 0.7 * np.arange(len(shifts))
    how: dict[str, Any] = {"axis_row": axis[1], "shifts": shifts}
    if cone:
        views = Geometry.cone(angles, (rows, cols), 2 * pitch, 1000 * pitch, 2000 * pitch, axis_col=axis[0], **how)
    else:
        views = Geometry.parallel(angles, (rows, cols), pixel_pitch=pitch, axis_col=axis[0], **how)
    voxel = pitch * coarser
    (*_, bottom), (x, y, top) = Grid.of_field(views, voxel).edges
    u, z = np.stack([_edges(views, view) for view in range(views.n_views)], axis=1)
    slack = 1e-5 * voxel
    # The plane of the axis turns: what is seen at u is somewhere on the circle of that radius.
    assert x == y and np.abs(u).max() - slack <= x < np.abs(u).max() + voxel / 2 + slack
    assert bottom <= z.min() + slack and z.max() - slack <= top
    assert top - bottom < np.ptp(z) + voxel + slack and top + bottom == pytest.approx(z.min() + z.max(), abs=slack)


def test_shifts_common_to_all_views_equal_a_moved_axis() -> None:
    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    moved = Geometry.parallel(angles, (10, 32), axis_col=29.5, axis_row=14.5)
    shifted = Geometry.parallel(angles, (10, 32), shifts=np.tile([14.0, 10.0], (48, 1)))
    assert Grid.of_field(moved, 1.0) == Grid.of_field(shifted, 1.0) == Grid((10, 60, 60), centre=(-10.0, 0, 0))
    beyond = Geometry.parallel(angles, (10, 48), axis_col=-20)
    assert Grid.of_field(beyond, 1.0).shape == (10, 135, 135)  # to 67.5 pixels from the axis


@given(sod=st.floats(3, 60), voxel=st.floats(1, 9), axis=st.floats(0, 40))
def test_the_field_of_a_wide_cone_ends_before_its_source(sod: float, voxel: float, axis: float) -> None:
    views = Geometry.cone([0.0, 2.0], (5, 40), 2.0, sod, 2 * sod, axis_col=axis)
    field = Grid.of_field(views, min(voxel, sod))
    beyond = field.voxel_size / 2  # where voxels are interpolated to zero
    assert np.hypot(*(field.edges[1, :2] + beyond)) < sod or field.shape[1] == 1
    assert field.edges[1, 0] >= min(views.reach, 0.7 * sod - field.voxel_size) * (1 - 1e-9)


def test_a_fit_takes_voxels_like_those_wanted_from_one_to_four_pixels() -> None:
    views = Geometry.cone([0.0], (8, 32), 1.0, 100.0, 200.0)  # pixels of 0.5 mm
    for wanted, edge in ((0.1, 0.5), (0.5, 0.5), (1.2, 1.2), (2.0, 2.0), (32.0, 2.0)):
        assert Grid.for_fit(views, Grid((1, 1, 1), wanted)) == Grid.of_field(views, edge)


def test_a_grid_follows_the_height_of_the_axis_row() -> None:
    view = Geometry.parallel([0.0], (5, 8), pixel_pitch=0.5, axis_row=3.0)  # the middle row, 2, is one row below z = 0
    assert Grid.matching(view).centre[0] == pytest.approx(-0.5)
    assert Grid.of_field(view, 0.5).centre[0] == pytest.approx(-0.5)


def test_voxels_may_be_longer_along_z() -> None:
    grid = Grid((4, 6, 6), 0.5, slice_pitch=2.0)
    assert grid.spacing == (2.0, 0.5, 0.5)
    np.testing.assert_allclose(grid.coordinates()[0], [-3, -1, 1, 3])
    np.testing.assert_allclose(grid.edges[:, 2], [-4, 4])
    with refused(ValueError):
        Grid((4, 6, 6), 0.5, slice_pitch=0.0)
