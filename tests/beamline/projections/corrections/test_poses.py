"""Poses from a file become geometry: they are read, assigned to projections, and stored with the volume."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import ConfigError, DataError
from beamline.projections.corrections.air import Air
from beamline.projections.corrections.poses import PosesOfFile
from beamline.projections.corrections.resampling import TiltAndLens
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.storage.pose_table import read_poses
from recon.base.geometry import Geometry
from recon.base.vectors import vectors_of
from recon.base.volume import Grid
from recon.voxels.direct import direct
from recon.voxels.projector import seen_rays
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import DARK, frames_through, write_flagged
from tests.messages import refused
from tests.recon.voxels.test_projector import ellipsoid_shadow, smooth_ball
from tests.slow_cases import others_slow

SHAPE, PITCH, AXIS = (24, 40), 0.04, 20.6
N, FIRST = 40, 4  # views; row of the first one: two darks, two flats
DEGREES = (np.arange(N) * 7 % N) * 180 / N  # in no order
AXES, CENTRE = np.array([0.45, 0.3, 0.25]), np.array([0.1, -0.1, 0.04])
SHIFTS = np.stack((3 * np.cos(np.arange(N)), 2 * np.sin(2 * np.arange(N))), axis=1)
TURNS = np.stack((np.full(N, 1.5), 0.5 * np.cos(np.arange(N))), axis=1)
COLUMNS = "shift_col_px,shift_row_px,roll_deg,tilt_deg"


def posed(turns: np.ndarray = TURNS) -> Geometry:
    roll, tilt = np.radians(turns.T)
    return Geometry.parallel(
        np.radians(DEGREES), SHAPE, pixel_pitch=PITCH, axis_col=AXIS, shifts=SHIFTS, roll=roll, tilt=tilt
    )


def scan(folder: Path, geometry: Geometry, axes: np.ndarray = AXES) -> Path:
    counts = DARK + 40_000 * np.exp(-ellipsoid_shadow(geometry, axes, CENTRE))
    frames = frames_through(counts, geometry.angles, beam=40_000)
    return write_flagged(folder / "scan.h5", frames, {}, pixel_size_mm=PITCH)


def table(folder: Path, head: str, *columns: np.ndarray, name: str = "poses.csv") -> Path:
    rows = [",".join(repr(float(value)) for value in row) for row in zip(*columns, strict=True)]
    (folder / name).write_text("\n".join(["# wobble", head, *rows]) + "\n")
    return folder / name


def every(folder: Path, by: str = "view") -> Path:
    keys = {"view": np.arange(N), "frame": FIRST + np.arange(N), "angle_deg": DEGREES}[by]
    order = np.random.default_rng(3).permutation(N)
    return table(folder, f"{by},{COLUMNS}", *(column[order] for column in (keys, *SHIFTS.T, *TURNS.T)))


def prepared(path: Path, poses: Path | str, **selected: object) -> PreparedProjections:
    steps = (Air("none"), PosesOfFile(read_poses(str(poses))))
    asked: dict[str, Any] = {"axis_col": AXIS, "steps": steps, **selected}
    return prepare(path, Selection(**asked))[0]


def error(found: PreparedProjections, axes: np.ndarray = AXES) -> float:
    """Of FBP, relative, in the frame of the whole detector."""
    grid = Grid.matching(found.geometry)
    truth = smooth_ball(grid, axes, CENTRE)
    made = direct(found.seen.data, found.geometry, grid, "hann")
    return float(np.linalg.norm(made - truth) / np.linalg.norm(truth))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scan of these poses."""
    return scan(tmp_path_factory.mktemp("posed"), posed())


@pytest.mark.parametrize("by", others_slow(["view", "frame", "angle_deg"]))
def test_poses_are_those_of_the_file_in_any_order_and_no_pixel_is_resampled(
    path: Path, tmp_path: Path, by: str
) -> None:
    found = prepared(path, every(tmp_path, by))
    plain, _ = prepare(path, Selection(axis_col=AXIS, steps=(Air("none"),)))
    for name in ("angles", "shifts", "roll", "tilt"):
        np.testing.assert_allclose(getattr(found.geometry, name), getattr(posed(), name), atol=1e-12)
    assert error(found) < 0.2 < 0.5 * error(plain)
    np.testing.assert_array_equal(found.seen.data, plain.seen.data)
    assert found.origin.done["poses"].sentence.startswith("40 poses from")


VECTOR_COLUMNS = "{0}_x,{0}_y,{0}_z,d_x,d_y,d_z,u_x,u_y,u_z,v_x,v_y,v_z"


def free(*, cone: bool) -> Geometry:
    """Laminography of a parallel beam, or a cone whose source circles at heights and distances of its own."""
    if not cone:
        return replace(posed(), tilt=np.full(N, np.radians(30.0)))
    views = Geometry.cone(2 * np.radians(DEGREES), SHAPE, 1.5 * PITCH, 10.0, 15.0, axis_col=AXIS, tilt=posed().tilt)
    return views.about(np.stack((0.1 * np.cos(DEGREES), 0.2 * np.sin(DEGREES), np.linspace(-0.3, 0.3, N)), 1))


@pytest.mark.parametrize(
    ("cone", "selected"), others_slow([(False, {"rows": (3, 21), "binning": 2}), (True, {"rows": (3, 21)})])
)
def test_vectors_state_all_of_the_geometry(tmp_path: Path, cone: bool, selected: dict[str, object]) -> None:
    """The true sample explains the views along the rays that a CSV and an .npz state, whatever angles the scan has."""
    geometry = free(cone=cone)
    path = scan(tmp_path, geometry)
    selected |= {"axis_col": None, "cone": (9.0, 15.0) if cone else None, "pixel_size_mm": geometry.pixel_pitch}
    columns = f"view,{VECTOR_COLUMNS.format('src' if cone else 'ray')}"
    text = table(tmp_path, columns, np.arange(N), *vectors_of(geometry).T)
    stated: dict[str, Any] = {"cone_vec" if cone else "parallel3d_vec": vectors_of(geometry)}
    np.savez(tmp_path / "vectors.npz", **stated)
    found, of_arrays = (prepared(path, file, **selected) for file in (text, tmp_path / "vectors.npz"))
    np.testing.assert_allclose(vectors_of(found.geometry), vectors_of(of_arrays.geometry), atol=1e-12)
    pixels = round(found.geometry.pixel_pitch / geometry.pixel_pitch)
    left = found.seen.data - shadow_of_pixels(found.geometry, pixels)
    assert np.abs(left).max() < 2e-3  # counts are rounded
    assert (
        found.origin.done["poses"].sentence == f"The geometry of 40 projections comes from the ASTRA vectors in {text}."
    )


def test_vectors_that_do_not_fit_the_scan_are_refused(path: Path, tmp_path: Path) -> None:
    columns, cone = f"view,{VECTOR_COLUMNS.format('src')}", vectors_of(free(cone=True))
    file = table(tmp_path, columns, np.arange(N), *cone.T)
    with refused(ConfigError):
        prepared(path, file, axis_col=None)
    with refused(ConfigError):
        prepared(path, file, axis_col=None, cone=(10.0, 15.0))
    with refused(ConfigError):
        prepared(path, file, cone=(10.0, 15.0))
    cone[5, 6:9] *= 1.1
    file = table(tmp_path, columns, np.arange(N), *cone.T)
    with refused(DataError):
        prepared(path, file, axis_col=None, cone=(10.0, 15.0))
    with refused(ValueError):
        read_poses(str(table(tmp_path, columns.replace(",u_z", ""), np.arange(N), *np.delete(cone, 8, axis=1).T)))
    np.savez(tmp_path / "others.npz", vectors=cone)
    with refused(ValueError):
        read_poses(str(tmp_path / "others.npz"))
    np.savez(tmp_path / "complex.npz", parallel3d_vec=cone * 1j)
    with refused(ValueError):
        read_poses(str(tmp_path / "complex.npz"))
    np.savez(tmp_path / "damaged.npz", cone_vec=cone)
    damaged = bytearray((tmp_path / "damaged.npz").read_bytes())
    damaged[300] ^= 255
    (tmp_path / "damaged.npz").write_bytes(damaged)
    with pytest.raises(ValueError, match=r"damaged\.npz"):
        read_poses(str(tmp_path / "damaged.npz"))


def shadow_of_pixels(views: Geometry, n: int) -> np.ndarray:
    """Line integrals of the mean light of n x n rays in each pixel."""
    (rows, cols), middle = views.detector_shape, (n - 1) / 2
    fine = replace(
        views, detector_shape=(n * rows, n * cols), pixel_pitch=views.pixel_pitch / n, shifts=n * views.shifts,
        axis_col=n * views.axis_col + middle, axis_row=n * views.axis_row + middle,
    )  # fmt: skip
    return -np.log(np.exp(-ellipsoid_shadow(fine, AXES, CENTRE)).reshape(-1, rows, n, cols, n).mean((2, 4)))


@pytest.mark.parametrize(
    "selected",
    others_slow([{"rows": (6, 20), "binning": 2}, {"views": "every:2"}, {"binning": 2}, {"rows": (3, 21)}]),
    ids=str,
)
def test_a_part_of_the_scan_keeps_its_rays(tmp_path: Path, selected: dict[str, object]) -> None:
    """The true sample explains the part's rays, also those of binned pixels and of rows off the middle."""
    turns = TURNS * (4, 1)  # pivot about the detector's middle, not the rows' one
    path = scan(tmp_path, posed(turns))
    found = prepared(path, table(tmp_path, f"view,{COLUMNS}", np.arange(N), *SHIFTS.T, *turns.T), **selected)
    left = found.seen.data - shadow_of_pixels(found.geometry, round(found.geometry.pixel_pitch / PITCH))
    assert np.abs(left).max() < 0.02 and np.sqrt(np.mean(left**2)) < 0.002
    assert found.geometry.n_views == (N // 2 if "views" in selected else N)
    if found.lines.unseen is not None:
        data, views = found.lines.unseen.data, found.lines.unseen.geometry
        np.testing.assert_allclose(data, ellipsoid_shadow(views, AXES, CENTRE), atol=0.012)


@pytest.mark.slow
def test_rays_outside_the_slices_weigh_nothing_also_of_views_held_out(tmp_path: Path) -> None:
    path = scan(tmp_path, posed(), AXES * (1, 1, 20))
    found = prepared(path, every(tmp_path), rows=(8, 16), views="every:2")
    assert found.lines.unseen is not None
    n, others = found.geometry.n_views, found.lines.unseen.geometry.n_views
    weights, grid = found.views.weights[...], Grid.matching(found.geometry)
    assert weights.shape[0] == n + others and 0 < weights.mean() < 1
    np.testing.assert_array_equal(weights[n:] > 0, seen_rays(found.lines.unseen.geometry, grid))
    assert not weights[n:].all()


@pytest.mark.slow
def test_the_axis_is_found_with_the_shifts(tmp_path: Path) -> None:
    drift = np.stack((np.linspace(0, 6, N)[np.argsort(np.argsort(DEGREES))], np.zeros(N)), axis=1)
    geometry = replace(posed(0 * TURNS), shifts=drift)
    found = prepared(
        scan(tmp_path, geometry), table(tmp_path, "view,shift_col_px", np.arange(N), drift[:, 0]), axis_col=None
    )
    assert found.origin.axis_col == pytest.approx(AXIS, abs=0.15)


def test_poses_of_all_views_are_not_needed_where_some_are_chosen(path: Path, tmp_path: Path) -> None:
    head, columns = f"view,{COLUMNS}", (np.arange(N), *SHIFTS.T, *TURNS.T)
    with refused(DataError):
        prepared(path, table(tmp_path, head, *(column[::2] for column in columns)))
    found = prepared(path, table(tmp_path, head, *(column[:30] for column in columns)), views="first:20")
    assert found.geometry.n_views == 20 and found.lines.unseen is not None and found.lines.unseen.geometry.n_views <= 10


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "first line is ''"),
        ("view,x\n0,1\n", "first line is 'view,x'"),
        ("view,shift_col_px\n", "header and no rows"),
        ("view,shift_col_px,colour\n0,1,2\n", "'colour' is unknown"),
        ("view,shift_col_px,shift_col_px\n0,1,2\n", "occurs twice"),
        ("view,shift_col_px\n0,a\n", "'0,a' are not 2 numbers"),
        ("view,shift_col_px\n0\n", "'0' are not 2 numbers"),
        ("view,shift_col_px\n0,\n", "'0,' are not 2 numbers"),
        ("view,shift_col_px\n0,nan\n", "view 0 has no finite shift"),
        ("view,shift_col_px\n0,1\n0,2\n", "view 0 has 2 rows"),
        ("view,shift_col_px\n0.5,1\n", r"view holds \[0.5\]; expected integers"),
        ("view,shift_col_px\n-1,1\n", r"view holds \[-1.0\]; expected integers"),
        ("angle_deg,roll_deg\ninf,1\n", r"angle_deg holds \[inf\]; expected finite angles"),
        ("view,tilt_deg\n3,86\n", "view 3 has a roll of 0 and a tilt of 86 degrees"),
    ],
)
def test_a_file_that_is_no_table_of_poses_is_refused(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / "poses.csv").write_text(text)
    with pytest.raises(ValueError, match=match):
        read_poses(str(tmp_path / "poses.csv"))
    with refused(ValueError):
        read_poses(str(tmp_path / "none.csv"))


def test_poses_that_do_not_fit_the_scan_are_refused(path: Path, tmp_path: Path) -> None:
    views = np.arange(N)
    for head, columns, match in (
        ("view,roll_deg", (np.append(views, N), np.zeros(N + 1)), f"states view {N}, but .* has {N} views"),
        ("view,shift_col_px", (views, np.full(N, 321.0)), "view 0 is displaced by 321 columns and 0 rows"),
        ("view,shift_row_px", (views, np.full(N, 25.0)), "view 0 is displaced by 0 columns and 25 rows"),
        (
            "view,angle_deg,roll_deg",
            (views, DEGREES + 2, TURNS[:, 0]),
            r"angle 2 degrees for frame 4, .* states 0 deg.*same scan",
        ),
        ("angle_deg,roll_deg", (DEGREES + 2.2, TURNS[:, 0]), "no pose for 40 of the 40 projections"),
    ):
        with pytest.raises(DataError, match=match):
            prepared(path, table(tmp_path, head, *columns))
    turned = (PosesOfFile(read_poses(str(every(tmp_path)))), TiltAndLens(1.0))
    with refused(ConfigError):
        prepared(path, every(tmp_path), steps=turned)


def nexus(folder: Path, **moved: np.ndarray) -> Path:
    path = folder / "motors.nxs"
    with h5py.File(path, "w") as file:
        detector = file.create_group("entry/instrument/detector")
        detector["data"] = np.zeros((FIRST + N, 2, 2), np.uint16)
        detector["image_key"] = [2, 2, 1, 1] + [0] * N
        for axis, values in moved.items():
            item = file.create_dataset(f"entry/sample/{axis}_translation", data=np.append(np.zeros(FIRST), values))
            item.attrs["units"] = "um"
    return path


@pytest.mark.slow
def test_translations_of_an_nxtomo_file_need_their_directions(tmp_path: Path) -> None:
    geometry = replace(posed(0 * TURNS), shifts=SHIFTS)
    path = scan(tmp_path, geometry)
    motors = nexus(tmp_path, x=12e3 + 1e3 * PITCH * SHIFTS[:, 0], z=-1e3 * PITCH * SHIFTS[:, 1])
    with pytest.raises(
        ValueError,
        match=r"^(?!.*damaged).*moves in x by 0.2\d* mm, z by 0.1\d* mm, but NeXus .*FILE:x,-y",
    ):
        read_poses(str(motors))
    found = prepared(path, f"{motors}:x,-z").geometry.shifts
    np.testing.assert_allclose(found - found[0], SHIFTS - SHIFTS[0], atol=1e-9)  # but for a common one
    assert np.abs(np.median(found, axis=0)).max() < 1e-9
    with pytest.raises(ValueError, match=r"y,x does not name two of the sample translations in the file \(x, z\)"):
        read_poses(f"{motors}:y,x")
    with pytest.raises(DataError, match="in a cone beam, translations of the sample in mm are not shifts"):
        prepared(path, f"{motors}:x,-z", cone=(50.0, 60.0))
    with pytest.raises(ValueError, match=r"^(?!.*damaged).*none of sample/x_translation"):
        read_poses(f"{nexus(tmp_path)}:x,-z") if motors.unlink() is None else None


@pytest.mark.slow
def test_a_cone_takes_poses_and_its_axis_is_found_in_them(tmp_path: Path) -> None:
    roll, tilt = np.radians(TURNS.T)
    angles, shift = 2 * np.radians(DEGREES), 6 * np.linspace(-1, 1, N)
    shifts = np.stack((shift, SHIFTS[:, 1]), axis=1)
    geometry = Geometry.cone(angles, SHAPE, 1.5 * PITCH, 10.0, 15.0, axis_col=AXIS, shifts=shifts, roll=roll, tilt=tilt)
    poses = table(tmp_path, f"view,{COLUMNS}", np.arange(N), shift, SHIFTS[:, 1], *TURNS.T)
    found = prepared(
        scan(tmp_path, geometry), poses, cone=(10.0, 15.0), pixel_size_mm=1.5 * PITCH, axis_col=None, rows=(2, 22)
    )
    assert found.origin.axis_col == pytest.approx(AXIS, abs=0.15)
    left = found.seen.data - ellipsoid_shadow(replace(found.geometry, axis_col=AXIS), AXES, CENTRE)
    assert np.abs(left).max() < 0.02


@pytest.mark.parametrize("mark", [" ", ","])
def test_vectors_of_astra_without_names_get_the_way_to_name_them(tmp_path: Path, mark: str) -> None:
    np.savetxt(tmp_path / "s.geom", np.eye(12)[:3], delimiter=mark)
    with pytest.raises(ValueError, match=r"12 numbers per line.*cone_vec=np.loadtxt\('s\.geom'\)"):
        read_poses(str(tmp_path / "s.geom"))
