"""Cone geometry, pixel size, mirrored frames and other scans in a NeXus file are used or named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.files.validate import describe, validate
from beamline.storage.readers.open import SourceOptions, open_scan
from tests.beamline.storage.readers.foreign_scans import CONE, DETECTOR, FRAMES, nxtomo, opened, put


def _turned(vertical: str, **turns: float) -> Callable[[h5py.Group], None]:
    vectors = {"rx": (1, 0, 0), "ry": (0, 1, 0), "rz": (0, 0, 1)}

    def add(entry: h5py.Group) -> None:
        group = f"{DETECTOR}/transformations"
        down = -np.array(vectors["r" + vertical])
        put(entry, f"{group}/gravity", 9.8, "m/s2", vector=down, transformation_type="translation")
        for name, angle in turns.items():
            put(entry, f"{group}/{name}", angle, "degree", vector=vectors[name], transformation_type="rotation")

    return add


def _axes(entry: h5py.Group) -> None:
    entry.create_group("data").attrs["axes"] = ["rotation_angle", "x", "y"]


@pytest.mark.parametrize(
    ("sod", "distance", "width", "cone"),
    [
        (-0.1, 0.1, 400e-6, True),  # a laboratory's
        (0.1, 0.1, 400e-6, True),  # without the sign
        (-145.0, 30.0, 1e-6, True),  # magnifies by 1.2
        (-52.0, 0.03, 0.67e-6, False),  # a synchrotron's
        (-0.5, 0.001, 0.02e-3, False),
        (-0.005, 1e-5, 1e-3, True),  # nearly no magnification, but a wide fan
    ],
)
def test_a_distance_of_the_source_makes_a_cone(
    tmp_path: Path, sod: float, distance: float, width: float, cone: bool
) -> None:
    changes = [("instrument/source/distance", sod, "m"), ("detector/distance", distance, "m")]
    path = nxtomo(tmp_path / "s.nx", *changes, *((f"detector/{side}_pixel_size", width, "m") for side in "xy"))
    source = opened(path)
    assert source.cone == (pytest.approx((abs(sod) * 1e3, (abs(sod) + distance) * 1e3)) if cone else None)
    assert source.pixel_size_mm == pytest.approx(width * 1e3)
    assert cone or "a parallel beam (magnification 1.00" in str(source.attributes["source_distance"])


def test_a_pixel_at_the_sample_is_magnified_to_that_on_the_detector(tmp_path: Path) -> None:
    at_sample = (("sample/x_pixel_size", 0.5, "um"), ("sample/y_pixel_size", 0.5, "um"))
    assert opened(nxtomo(tmp_path / "s.nx", *CONE, *at_sample)).pixel_size_mm == pytest.approx(1e-3)
    with pytest.raises(DataError, match=r"is 0 mm"):
        open_scan(nxtomo(tmp_path / "s.nx", ("instrument/source/distance", 0.0, "m"), CONE[1]))


UPSIDE_DOWN, LEFT_RIGHT = (slice(None, None, -1), slice(None)), (slice(None), slice(None, None, -1))


@pytest.mark.parametrize(
    ("changes", "also", "mirrored"),
    [
        ([("detector/x_flipped", True, None)], None, [LEFT_RIGHT]),
        ([("detector/y_flipped", 1, None)], None, [UPSIDE_DOWN]),
        ([("detector/y_flipped", "True", None), ("detector/x_flipped", True, None)], None, [UPSIDE_DOWN, LEFT_RIGHT]),
        ([("detector/y_flipped", False, None)], None, []),
        ([], _turned("z", ry=180.0, rz=0.0), [UPSIDE_DOWN]),
        ([], _turned("z", rz=-180.0), [LEFT_RIGHT]),
        ([], _turned("z", rx=180.0), [UPSIDE_DOWN, LEFT_RIGHT]),
        ([], _turned("y", ry=180.0), [LEFT_RIGHT]),
        ([], _turned("y", rx=180.0, rz=360.0), [UPSIDE_DOWN]),
        ([], _turned("y", rx=180.0, ry=180.0), [UPSIDE_DOWN, LEFT_RIGHT]),
    ],
)
def test_mirrored_frames_are_mirrored_back(
    tmp_path: Path,
    changes: list[tuple[str, Any, str | None]],
    also: Callable[[h5py.Group], None] | None,
    mirrored: list[tuple[slice, slice]],
) -> None:
    expected = FRAMES
    for part in mirrored:
        expected = expected[:, *part]
    with open_scan(nxtomo(tmp_path / "s.nx", *changes, also=also)) as source:
        for rows in (slice(None), slice(1, 3), slice(0, 4, 2), slice(3, 3)):
            np.testing.assert_array_equal(source.read([4, 0, 6], rows), expected[[4, 0, 6], rows])
        np.testing.assert_array_equal(list(source.frames())[3].counts, expected[3])


def test_another_turn_of_the_detector_is_named(tmp_path: Path) -> None:
    with open_scan(nxtomo(tmp_path / "s.nx", also=_turned("z", rx=5.0))) as source:
        assert source.not_used[0][:2] == ("detector/transformations", "rx 5°")
    hits = [hit for hit in validate(tmp_path / "s.nx") if "rx 5°" in hit.message]
    assert [hit.severity for hit in hits] == ["warning"]


@pytest.mark.parametrize("height", [0.5, 2.0, 1.01])
def test_pixels_that_are_not_square_are_told(tmp_path: Path, height: float) -> None:
    def said(*more: tuple[str, Any, str | None]) -> list[str]:
        path = nxtomo(tmp_path / "s.nx", ("detector/y_pixel_size", height, "um"), *more)
        assert describe(path)["pixel_height_mm"] == pytest.approx(height * 1e-3)
        return [hit.severity for hit in validate(path) if hit.rule == "pixel-height"]

    assert said() == ["info"]
    assert said(*CONE) == ["error"]


def test_another_scan_of_the_file_is_named(tmp_path: Path) -> None:
    def second(entry: h5py.Group) -> None:
        entry.file.attrs["default"] = entry.name
        entry.file.copy(entry, "entry0001")

    path = nxtomo(tmp_path / "s.nx", also=second)
    (hit,) = [hit for hit in validate(path) if hit.rule == "not-used"]
    other = f"/entry0001/{DETECTOR}/data"
    assert hit.severity == "warning" and f"--data-path {other}" in hit.message
    with open_scan(SourceOptions(path, data_path=other)) as source:
        assert source.not_used == ()


def test_frames_in_another_order_of_axes_of_nxdata_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"rotation_angle"):
        open_scan(nxtomo(tmp_path / "s.nx", also=_axes))


TURN = np.r_[0, 0, np.arange(5) * 36.0]


def _chained(*steps: tuple[str, object, dict[str, Any]], first: str) -> Callable[[h5py.Group], None]:
    """A sample without rotation_angle that depends on `first`; groups have a `value`."""

    def add(entry: h5py.Group) -> None:
        del entry["sample/rotation_angle"]
        entry["sample/depends_on"] = first
        for name, value, said in steps:
            said = {"transformation_type": "rotation", "vector": (0.0, 1, 0), "units": "deg", "depends_on": "."} | said
            entry[name] = value
            (entry[name].parent if name.endswith("/value") else entry[name]).attrs.update(said)
            entry[name].attrs["units"] = said["units"]

    return add


T = "sample/transformations"
X: tuple[str, object, dict[str, Any]] = (f"{T}/x", TURN, {"transformation_type": "translation", "depends_on": "omega"})
CHAINS: dict[str, tuple[Callable[[h5py.Group], None], int]] = {
    "a path from the root": (_chained((f"{T}/omega", TURN, {}), first=f"/entry0000/{T}/omega"), 1),
    "a path from the sample": (_chained((f"{T}/omega", TURN, {"vector": (0, 0, 1)}), first="transformations/omega"), 1),
    "radians behind a move": (
        _chained(X, (f"{T}/omega", np.radians(TURN), {"units": "rad"}), first=f"/entry0000/{T}/x"),
        1,
    ),
    "the other sense": (_chained((f"{T}/omega", TURN, {"vector": (0, -1, 0)}), first=f"/entry0000/{T}/omega"), -1),
    "a positioner": (_chained(("instrument/omega/value", TURN, {}), first="/entry0000/instrument/omega"), 1),
    "a tilt that stands": (
        _chained(
            (f"{T}/omega", TURN, {"depends_on": "tilt"}), (f"{T}/tilt", np.ones(7), {}), first=f"/entry0000/{T}/omega"
        ),
        1,
    ),
}


@pytest.mark.parametrize("chain", CHAINS)
def test_the_rotation_that_a_sample_depends_on(tmp_path: Path, chain: str) -> None:
    add, sense = CHAINS[chain]
    path = nxtomo(tmp_path / "s.nx", also=add)
    np.testing.assert_allclose(np.degrees(opened(path).table.angles), sense * TURN, atol=1e-12)
    warned = [hit.message for hit in validate(path) if hit.rule == "angles"]
    assert [f"--angles-path /entry0000/{T}/omega uses the angles as stored" in message for message in warned] == [
        True
    ] * (sense < 0)


@pytest.mark.parametrize(
    "add",
    [
        _chained((f"{T}/omega", TURN, {"depends_on": "phi"}), (f"{T}/phi", TURN, {}), first=f"/entry0000/{T}/omega"),
        _chained((f"{T}/omega", TURN, {"depends_on": "omega"}), first=f"/entry0000/{T}/omega"),  # in a circle
        _chained((f"{T}/omega", TURN, {}), first="."),
        _chained((f"{T}/omega", TURN, {}), first="/nowhere"),
    ],
)
def test_lists_that_may_be_angles_are_named(tmp_path: Path, add: Callable[[h5py.Group], None]) -> None:
    path = nxtomo(tmp_path / "s.nx", also=add)
    (error,) = [hit.message for hit in validate(path) if hit.severity == "error" and "have no angle" in hit.message]
    assert f"/entry0000/{T}/omega" in error and "may be the angles: --angles-path " in error
    with open_scan(SourceOptions(path, angles_path=f"/entry0000/{T}/omega")) as source:
        np.testing.assert_allclose(np.degrees(source.table.angles), TURN)
