"""The voxel projector compared with closed forms, an explicit matrix, its transpose and another implementation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import sparse

from recon.base.geometry import Geometry
from recon.base.ray_width import RayWidth
from recon.base.volume import Grid, Volume
from recon.voxels.projector import Projector, measured_share, project
from tests.messages import refused
from tests.recon.helpers import assert_transpose
from tests.recon.kernels.voxels_reference import system_matrix


def _gaussian_case(
    angles: list[float], axis_col: float, pitch: float, centre: tuple[float, float], sigma: float
) -> tuple[Volume, Geometry, np.ndarray]:
    """A Gaussian blob at (x, y) = centre (voxels): its line integrals are a Gaussian in u, sigma sqrt(2π) high."""
    geometry = Geometry.parallel(angles, (3, 48), pixel_pitch=pitch, axis_col=axis_col)
    grid = Grid((3, 40, 44), pitch)
    _, y, x = grid.coordinates()
    x0, y0, s = centre[0] * pitch, centre[1] * pitch, sigma * pitch
    blob = np.exp(-((x[None, :] - x0) ** 2 + (y[:, None] - y0) ** 2) / (2 * s * s))
    data = (np.array([1.0, 2.0, 0.0])[:, None, None] * blob).astype(np.float32)
    u = (np.arange(48) - axis_col) * pitch
    shadow = np.stack([np.exp(-((u - x0 * np.cos(t) - y0 * np.sin(t)) ** 2) / (2 * s * s)) for t in angles])
    truth = np.sqrt(2 * np.pi) * s * np.array([1.0, 2.0, 0.0])[None, :, None] * shadow[:, None, :]
    return Volume(data, grid), geometry, truth


def _number(draw: st.DrawFn, low: float, high: float) -> float:
    return draw(st.floats(low, high, width=32))


@st.composite
def cases(draw: st.DrawFn) -> tuple[Geometry, Grid, int]:
    """Small set-ups of either beam: any angles, axis, shifts, roll, tilt and centres, box and voxel, and a seed."""
    number = partial(_number, draw)
    views = draw(st.integers(1, 3))
    angles = [draw(st.sampled_from([0.0, np.pi / 4, np.pi / 2])) if draw(st.booleans()) else number(-7, 7)
              for _ in range(views)]  # fmt: skip
    detector = draw(st.tuples(st.integers(1, 6), st.integers(1, 9)))
    shifts = np.array([[number(-2, 2), number(-2, 2)] for _ in range(views)])
    axis_col, axis_row = number(-1, 9), number(-1, 6)
    lean = draw(st.sampled_from([0.0, 0.03125, 1.25]))
    roll, tilt = ([number(-lean, lean) for _ in range(views)] for _ in range(2))
    if draw(st.booleans()):
        geometry = Geometry.cone(angles, detector, number(0.5, 3), 20.0, number(20, 60), axis_col=axis_col,
                                 axis_row=axis_row, shifts=shifts, roll=roll, tilt=tilt)  # fmt: skip
        if draw(st.booleans()):
            geometry = geometry.about([[number(-3, 3) for _ in range(3)] for _ in range(views)])
    else:
        geometry = Geometry.parallel(angles, detector, pixel_pitch=number(0.5, 2), axis_col=axis_col, axis_row=axis_row,
                                     shifts=shifts, roll=roll, tilt=tilt)  # fmt: skip
    shape = draw(st.tuples(st.integers(1, 7), st.integers(1, 8), st.integers(1, 8)))
    centre = (number(-2, 2), number(-2, 2), number(-2, 2))
    slice_pitch = number(0.5, 2) if draw(st.booleans()) else None
    return geometry, Grid(shape, number(0.5, 1.5), centre, slice_pitch), draw(st.integers(0, 2**31))


@given(cases())
def test_both_directions_are_the_explicit_matrix(case: tuple[Geometry, Grid, int]) -> None:
    _assert_the_matrix(*case, lambda matrix: 1.6e-4 * abs(matrix).sum() / max(1, matrix.nnz))


def _samples(geometry: Geometry, grid: Grid) -> Projector:
    """Joseph's samples alone, neither sharpened nor spread over a pixel."""
    return Projector(geometry.seen_with(RayWidth(pixel=1e-6)), grid).plain


def _assert_the_matrix(geometry: Geometry, grid: Grid, seed: int, room: Callable[[sparse.csr_array], float]) -> None:
    rng = np.random.default_rng(seed)
    projector, matrix = _samples(geometry, grid), system_matrix(geometry, grid)
    volume = rng.random(grid.shape, dtype=np.float32)
    views = rng.random(projector.projection_shape, dtype=np.float32)
    expected = (matrix @ volume.ravel()).reshape(views.shape)
    np.testing.assert_allclose(projector.forward(volume), expected, rtol=2e-5, atol=room(matrix))
    expected = (matrix.T @ views.ravel()).reshape(volume.shape)
    np.testing.assert_allclose(projector.adjoint(views), expected, rtol=2e-5, atol=room(matrix))


@given(cases())
def test_the_transpose_is_exact(case: tuple[Geometry, Grid, int]) -> None:
    """To the rounding of float32 sums, and of the coordinates of a ray that grazes a voxel."""
    geometry, grid, seed = case
    assert_transpose(Projector(geometry, grid), np.random.default_rng(seed), rel=2e-6, abs=1e-7 * grid.voxel_size)


@st.composite
def slices(draw: st.DrawFn) -> tuple[Geometry, Grid, int]:
    """A single slice of several bands of lines, by a parallel beam or a fan, some of it beyond the box or the field."""
    number = partial(_number, draw)
    angles = [number(-7, 7), draw(st.sampled_from([0.0, np.pi / 4, np.pi / 2, np.pi]))]
    cols, shifts = draw(st.integers(1, 60)), [number(-3, 3), number(-3, 3)]
    axis_col, box = number(-5, 65), draw(st.tuples(st.integers(1, 50), st.integers(1, 50)))
    if draw(st.booleans()):
        views = Geometry.fan(angles, cols, number(0.5, 3), 50.0, number(60, 120), axis_col=axis_col, shifts=shifts)
    else:
        moved = np.stack([shifts, [0.0, 0.0]], axis=1)
        views = Geometry.parallel(angles, (1, cols), pixel_pitch=number(0.25, 3), axis_col=axis_col, shifts=moved)
    return views, Grid((1, *box), number(0.5, 1.25), (0.0, number(-5, 5), number(-5, 5))), draw(st.integers(0, 2**31))


@given(slices())
def test_a_single_slice_is_the_explicit_matrix_in_both_directions(case: tuple[Geometry, Grid, int]) -> None:
    _assert_the_matrix(*case, lambda matrix: 4e-5 * (abs(matrix).max() if matrix.nnz else 1.0))


@pytest.mark.parametrize("fan", [False, True])
def test_the_transpose_of_a_single_slice_is_exact_at_a_working_size(fan: bool, rng: np.random.Generator) -> None:
    angles = np.arange(37) * 0.37
    views = Geometry.fan(angles, 200, 1.0, 300.0, 400.0) if fan else Geometry.parallel(angles, (1, 200))
    projector = Projector(views, Grid((1, 170, 130), 1.1))
    volume, forward = assert_transpose(projector, rng, rel=1e-7)
    np.testing.assert_array_equal(projector.forward(volume), forward)
    np.testing.assert_array_equal(projector.subset([30, 2]).forward(volume), forward[[30, 2]])


@pytest.mark.parametrize("cone", [False, True])
@pytest.mark.parametrize("lean", [0.0, 0.03])
def test_the_transpose_is_exact_at_a_working_size(cone: bool, lean: float, rng: np.random.Generator) -> None:
    """Many jobs a thread, more slices than one job takes: no thread writes where another does."""
    angles = np.arange(37) * 0.37
    shape = (300, 40)
    geometry = (
        Geometry.cone(angles, shape, 0.1, 40.0, 60.0) if cone else Geometry.parallel(angles, shape, pixel_pitch=0.05)
    )
    geometry = replace(geometry, roll=lean * np.sin(angles), tilt=lean * np.cos(angles))
    projector = Projector(geometry, Grid((290, 30, 36), 0.055))
    volume, forward = assert_transpose(projector, rng, rel=1e-7)
    np.testing.assert_array_equal(projector.forward(volume), forward)  # no race: the same bits again
    np.testing.assert_array_equal(projector.subset([30, 2]).forward(volume), forward[[30, 2]])


def test_tiles_make_no_difference(rng: np.random.Generator) -> None:
    """Rays through many tiles, along their edges too, more slices than a job takes: the explicit matrix, whatever the
    number of threads, to the bit."""
    geometry = Geometry.parallel(
        [0.0, np.pi / 2, np.pi / 4, 0.3, 1.2, 2.0, 2.9], (75, 84), pixel_pitch=1.0, axis_col=42.5
    )
    projector, matrix = _samples(geometry, Grid((75, 97, 66))), system_matrix(geometry.rows(0, 1), Grid((1, 97, 66)))
    volume = rng.random(projector.grid.shape, dtype=np.float32)
    views = rng.random(projector.projection_shape, dtype=np.float32)
    forward, adjoint = projector.forward(volume), projector.adjoint(views)
    expected = matrix @ volume.reshape(75, -1).T
    np.testing.assert_allclose(forward.swapaxes(1, 2).reshape(-1, 75), expected, rtol=2e-6, atol=2e-6 * expected.max())
    expected = matrix.T @ views.swapaxes(1, 2).reshape(-1, 75)
    np.testing.assert_allclose(adjoint.reshape(75, -1).T, expected, rtol=2e-6, atol=2e-6 * expected.max())
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        np.testing.assert_array_equal(projector.forward(volume), forward)
        np.testing.assert_array_equal(projector.adjoint(views), adjoint)
    finally:
        numba.set_num_threads(threads)


@pytest.mark.parametrize("slices_a_row", [0.02, 0.3, 0.6, 0.75, 1.0, 1.7, 2.4, 9.0, 60.0])
def test_steps_of_any_length_make_no_difference(slices_a_row: float, rng: np.random.Generator) -> None:
    """Sixteen rows of a cone meet few slices, or more than two vectors hold; some rows and slices see nothing."""
    shifts = np.array([[0.3, 0.0], [-1.2, 25.0], [0.0, -40.0]])
    geometry = Geometry.cone([0.3, 2.4, 4.0], (40, 7), 1.0, 60.0, 75.0, axis_row=20.0, shifts=shifts)
    grid = Grid((37, 35, 3), 1.1, (3.0, -2.0, 4.0), geometry.sample_pitch / slices_a_row)
    projector, matrix = _samples(geometry, grid), system_matrix(geometry, grid)
    volume = rng.random(grid.shape, dtype=np.float32)
    views = rng.random(projector.projection_shape, dtype=np.float32)
    expected = (matrix @ volume.ravel()).reshape(views.shape)
    np.testing.assert_allclose(projector.forward(volume), expected, atol=3e-6 * expected.max())
    expected = (matrix.T @ views.ravel()).reshape(volume.shape)
    np.testing.assert_allclose(projector.adjoint(views), expected, atol=3e-6 * expected.max())


def ellipsoid_shadow(geometry: Geometry, axes: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """Chords [view, row, col] through the ellipsoid |(x - centre) / axes| <= 1: a quadratic along each ray."""
    rows, cols = geometry.detector_shape
    out = np.zeros((geometry.n_views, rows, cols))
    for view in range(geometry.n_views):
        along_u, along_v, beam = geometry.axes(view)
        col0, row0 = geometry.origin(view)
        u, v = np.meshgrid(np.arange(cols) - col0, np.arange(rows) - row0)
        on_detector = (u[..., None] * along_u + v[..., None] * along_v) * geometry.pixel_pitch
        origin = geometry.centres[view] - geometry.sod * beam if geometry.is_cone else on_detector
        run = on_detector + geometry.sdd * beam if geometry.is_cone else np.broadcast_to(beam, on_detector.shape)
        p, d = (origin - centre) / axes, run / axes
        a, b, c = (d * d).sum(-1), (p * d).sum(-1), (p * p).sum(-1) - 1
        out[view] = 2 * np.sqrt(np.maximum(b * b - a * c, 0)) / a * np.linalg.norm(run, axis=-1)
    return out


def smooth_ball(grid: Grid, axes: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float32]:
    """Share of each voxel [z, y, x] inside the ellipsoid, (x, y, z) axes, from 4³ points; read-only."""
    return _smooth_ball(grid, tuple(axes), tuple(centre))


@cache
def _smooth_ball(grid: Grid, axes: tuple[float, ...], centre: tuple[float, ...]) -> NDArray[np.float32]:
    fine = Grid(tuple(4 * n for n in grid.shape), grid.voxel_size / 4, grid.centre)  # type: ignore[arg-type]
    z, y, x = fine.coordinates()
    inside = (
        ((x - centre[0]) / axes[0]) ** 2
        + ((y[:, None] - centre[1]) / axes[1]) ** 2
        + ((z[:, None, None] - centre[2]) / axes[2]) ** 2
    ) <= 1
    nz, ny, nx = grid.shape
    shares = inside.reshape(nz, 4, ny, 4, nx, 4).mean((1, 3, 5), dtype=np.float32)
    shares.flags.writeable = False
    return shares


@pytest.mark.parametrize(("cone", "lean"), [(False, 0.0), (True, 0.0), (False, 0.5), (True, 0.02), (True, 1.3)])
def test_an_ellipsoid_projects_to_its_chords(cone: bool, lean: float) -> None:
    angles = [0.0, 0.5, np.pi / 4, 2.0, 4.0]
    shifts = np.array([[0, 0], [1.3, 0], [0, -2.6], [0, 0], [-2.0, 1.0]])
    roll, tilt = lean * np.array([1, 0, -1, 0.5, 0.7]), lean * np.array([0, 1, 0.3, -1, 0.7])
    if cone:
        geometry = Geometry.cone(
            angles, (44, 50), 0.06, 6.0, 9.0, axis_col=26.2, axis_row=19.3, shifts=shifts, roll=roll, tilt=tilt
        )
    else:
        geometry = Geometry.parallel(
            angles, (44, 50), pixel_pitch=0.04, axis_col=26.2, axis_row=19.3, shifts=shifts, roll=roll, tilt=tilt
        )  # fmt: skip
    axes, centre = np.array([0.5, 0.35, 0.6]), np.array([0.12, -0.2, 0.1])
    grid = Grid((60, 64, 62), 0.025, (0.05, -0.1, 0.05))
    found = project(Volume(smooth_ball(grid, axes, centre), grid), geometry)
    truth = ellipsoid_shadow(geometry, axes, centre)
    error = found - truth
    # Voxels of 0.025 mm blur the rim, where chords rise as a square root; elsewhere they are right to a part in 200.
    inside = truth > 0.4 * truth.max()
    assert np.abs(error[inside]).max() < 0.02 * truth.max()
    assert np.sqrt(np.mean(error[inside] ** 2)) < 0.004 * truth.max()
    assert abs(error.sum()) < 0.002 * truth.sum()


def test_parallel_projections_agree_with_astra(rng: np.random.Generator) -> None:
    astra = pytest.importorskip("astra", reason="astra-toolbox, the other implementation, is not installed")
    image = rng.random((20, 24), dtype=np.float32)
    angles = np.array([0.3, 1.1, 2.7])
    box = astra.create_vol_geom(20, 24)
    views = astra.create_proj_geom("parallel", 1.0, 30, angles)
    _, theirs = astra.create_sino(image, astra.create_projector("linear", views, box))
    # Its y axis points against its rows.
    ours = project(
        Volume(np.ascontiguousarray(image[None, ::-1]), Grid((1, 20, 24))), Geometry.parallel(angles, (1, 30))
    )
    np.testing.assert_allclose(ours[:, 0], theirs, rtol=1e-4, atol=1e-4)


def test_misfits_are_named() -> None:
    volume, geometry, _ = _gaussian_case([0.1], 23.5, 1.0, (2.0, 1.0), 3.0)
    with refused(ValueError):  # a half cone of 50 degrees, tilted by 44
        project(volume, Geometry.cone([0.1], (145, 48), 1.0, 60.0, 60.0, tilt=np.deg2rad(44)))
    with refused(ValueError):
        project(volume, Geometry.cone([0.1], (3, 48), 1.0, 20.0, 40.0))
    near = Geometry.cone([0.1, np.pi / 4], (3, 48), 1.0, 1.02 * 4 * np.sqrt(2), 40.0)
    with refused(ValueError):  # which has weight in rays, behind the source
        Projector(near, Grid((1, 8, 8)))
    with refused(ValueError):
        Projector(geometry, volume.grid).forward(np.zeros((3, 2, 2), np.float32))


def test_it_reads_as_a_matrix() -> None:
    geometry = Geometry.parallel(np.linspace(0, np.pi, 5, endpoint=False), (3, 12))
    a = Projector(geometry, Grid.matching(geometry))
    x = np.random.default_rng(0).random(a.grid.shape, dtype=np.float32)
    y = np.random.default_rng(1).random(a.projection_shape, dtype=np.float32)

    assert float((a(x) * y).sum()) == pytest.approx(float((x * a.T(y)).sum()), rel=1e-5)


def test_the_share_of_known_rows_is_1_0_or_between_by_what_a_voxel_s_rays_meet() -> None:
    known = np.ones(20, np.bool_)
    known[4:9] = False
    beam = Geometry.parallel(np.pi * np.arange(40) / 40, (20, 24))
    np.testing.assert_allclose(measured_share(known, beam, Grid.matching(beam))[:, 12, 12], known, atol=1e-6)
    cone = Geometry.cone(2 * np.pi * np.arange(40) / 40, (20, 24), 1.0, 50.0, 100.0)
    share = measured_share(known, cone, Grid.matching(cone))
    assert (share[5:8, 12, 12] == 0).any() and (share[12:] == 1).all()
    off = share[:, 12, 2]  # beside the axis a voxel is now nearer to the source, now farther away
    assert ((off > 0.1) & (off < 0.9)).any()
