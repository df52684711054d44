"""Each field of NXtomo and Data Exchange in the lists is used, or named by `info` and `validate`; row by row."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.files.ingest import ingest
from beamline.features.files.validate import describe, validate
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.fields import EXCHANGE, NXTOMO, Entry
from beamline.storage.readers.open import SourceOptions, open_scan

ROWS, COLS, VIEWS = 4, 6, 5
KEY = np.r_[2, 1, [0] * VIEWS]
DETECTOR = "instrument/detector"
FRAMES = np.random.default_rng(3).integers(100, 60000, (2 + VIEWS, ROWS, COLS)).astype(np.uint16)


def put(parent: h5py.Group, where: str, value: Any, units: str | None = None, **attributes: Any) -> None:
    if where in parent:
        del parent[where]
    parent[where] = value
    if units is not None:
        parent[where].attrs["units"] = units
    parent[where].attrs.update(attributes)


def nxtomo(path: Path, *changes: tuple[str, Any, str | None], also: Callable[[h5py.Group], None] | None = None) -> Path:
    """A foreign NXtomo with other values or more of them, below its entry."""
    with h5py.File(path, "w") as file:
        entry = file.create_group("entry0000")
        put(entry, "definition", "NXtomo")
        put(entry, f"{DETECTOR}/data", FRAMES)
        put(entry, f"{DETECTOR}/image_key", KEY)
        put(entry, f"{DETECTOR}/x_pixel_size", 1e-3, "mm")
        put(entry, f"{DETECTOR}/y_pixel_size", 1e-6, "m")
        put(entry, "sample/rotation_angle", np.r_[0, 0, np.arange(VIEWS) * 36.0], "degree")
        for where, value, units in changes:
            put(entry, f"instrument/{where}" if where.startswith("detector/") else where, value, units)
        if also is not None:
            also(entry)
    return path


def exchange(path: Path, *changes: tuple[str, Any, str | None], axes: str | None = None) -> Path:
    order = [["theta", "y", "x"].index(axis) for axis in (axes or "theta:y:x").split(":")]
    with h5py.File(path, "w") as file:
        for name, kind in (("data_dark", 2), ("data_white", 1), ("data", 0)):
            file[f"exchange/{name}"] = np.ascontiguousarray(FRAMES[kind == KEY].transpose(order))
        if axes is not None:
            file["exchange/data"].attrs["axes"] = axes
        put(file, "exchange/theta", np.arange(VIEWS) * 36.0, "deg")
        for where, value, units in changes:
            put(file, where, value, units)
    return path


MATTERS: dict[str, tuple[Any, str | None]] = {  # values of a field that is not used, and that may change the volume
    "detector/beam_center_x": (0.0, "pixel"),
    "detector/beam_center_y": (9.0, None),
    "detector/magnification": (10.0, None),
    "detector/polar_angle": (3.0, "degree"),
    "detector/azimuthal_angle": (3.0, "degree"),
    "detector/x_translation": (np.r_[0, 0, np.arange(VIEWS)] * 1e-6, "m"),
    "detector/y_translation": (np.r_[0, 0, np.arange(VIEWS)] * 1e-6, "m"),
    "sample/x_translation": (np.r_[0, 0, np.arange(VIEWS)] * 1e-3, "mm"),
    "sample/y_translation": (np.r_[0, 0, np.arange(VIEWS)] * 1e-3, None),
    "sample/z_translation": (np.r_[0, 0, np.arange(VIEWS)] * 1e-6, "m"),
    "sample/polar_angle": (3.0, "degree"),
    "detector/flatfield_applied": (True, None),
    "detector/angular_calibration_applied": (1, None),
    "exchange/data_shift_x": (np.arange(VIEWS), None),
    "exchange/data_shift_y": (np.arange(VIEWS), None),
    "measurement/instrument/interferometer/number_of_grid_steps": (8, None),
}
HARMLESS: dict[str, Any] = {  # of those, values that change nothing
    "detector/beam_center_x": 2.5,
    "detector/beam_center_y": 1.5,
    "detector/magnification": 1.0,
    "sample/x_translation": np.r_[1, 2, [3.0] * VIEWS],  # the sample is moved out for flats
    "sample/y_translation": np.r_[1, 2, [3.0] * VIEWS],
    "sample/z_translation": np.r_[1, 2, [3.0] * VIEWS],
    "detector/x_translation": np.r_[1, 2, [3.0] * VIEWS],
    "detector/y_translation": np.r_[1, 2, [3.0] * VIEWS],
    "exchange/data_shift_x": np.zeros(VIEWS),
    "exchange/data_shift_y": np.zeros(VIEWS),
    "measurement/instrument/interferometer/number_of_grid_steps": 1,
}
CONE = (("instrument/source/distance", -0.01, "m"), ("detector/distance", 0.01, "m"))


@pytest.mark.parametrize("field", [field for field in (*NXTOMO, *EXCHANGE) if not field.used], ids=lambda f: f.where)
def test_what_is_not_used_is_named(tmp_path: Path, field: Entry) -> None:
    def said(value: Any, units: str | None) -> str:
        change = (field.where, value, units)
        path = exchange(tmp_path / "s.h5", change) if field in EXCHANGE else nxtomo(tmp_path / "s.nx", *CONE, change)
        (hit,) = [hit for hit in validate(path) if hit.rule == "not-used"]
        assert f"The file states {field.where}, " in hit.message and field.use in hit.message
        return hit.severity

    assert said(HARMLESS.get(field.where, 0.0), "um") == "info"
    (path,) = tmp_path.iterdir()
    assert describe(path)["not_used"][field.where].endswith(f"(not used: {field.use})")
    assert (field.matters is not None) == (field.where in MATTERS)
    if field.matters is not None:
        value, units = MATTERS[field.where]
        assert said(value, units) == "warning"


def opened(path: Path) -> ScanSource:
    with open_scan(path) as source:
        source.read([0])
        return source


def _axes(entry: h5py.Group) -> None:
    entry.create_group("data").attrs["axes"] = ["rotation_angle", "x", "y"]


def _turned(vertical: str, **turns: float) -> Callable[[h5py.Group], None]:
    vectors = {"rx": (1, 0, 0), "ry": (0, 1, 0), "rz": (0, 0, 1)}

    def add(entry: h5py.Group) -> None:
        group = f"{DETECTOR}/transformations"
        down = -np.array(vectors["r" + vertical])
        put(entry, f"{group}/gravity", 9.8, "m/s2", vector=down, transformation_type="translation")
        for name, angle in turns.items():
            put(entry, f"{group}/{name}", angle, "degree", vector=vectors[name], transformation_type="rotation")

    return add


PLACES = ("detector", "sample")
WAVELENGTH = 12.39841984 / 25
USED_NX: dict[str, tuple[list[tuple[str, Any, str | None]], Callable[[ScanSource], object], Any]] = {
    "definition": ([("definition", "NXtomo", None)], lambda s: s.format, "nxtomo"),
    "detector/data": ([], lambda s: s.shape, (ROWS, COLS)),
    "detector/image_key": ([], lambda s: s.image_key.tolist(), KEY.tolist()),
    "detector/image_key_control": (
        [("detector/image_key_control", np.r_[2, 1, -1, [0] * 4], None)], lambda s: s.image_key[2], -1,
    ),
    "detector/count_time": ([("detector/count_time", np.full(7, 20.0), "ms")], lambda s: s.exposures[0], 0.02),
    **{f"{of}/x_pixel_size": ([(f"{of}/x_pixel_size", 2.0, "um")], lambda s: s.pixel_size_mm, 2e-3) for of in PLACES},
    **{f"{of}/y_pixel_size": ([(f"{of}/y_pixel_size", 2.0, "um")], lambda s: s.row_pitch_mm, 2e-3) for of in PLACES},
    "detector/distance": ([("detector/distance", 0.2, "m")], lambda s: s.attributes["distance_mm"], 200),
    "instrument/source/distance": (list(CONE), lambda s: s.cone, (10, 20)),
    "sample/rotation_angle": ([], lambda s: np.degrees(s.angles[-1]), 144),
    **{
        where: ([(where, "said", None)], lambda s, name=name: s.attributes[name], "said")
        for where, name in (
            ("sample/name", "sample"), ("title", "title"), ("start_time", "start_time"), ("end_time", "end_time"),
            ("instrument/name", "instrument"),
        )
    },
    "control/data": ([("control/data", np.arange(1.0, 8), None)], lambda s: s.currents.tolist()[6], 7),
    **{
        f"{where}/incident_energy": ([(f"{where}/incident_energy", 25e3, "eV")], lambda s: s.energy_kev, 25)
        for where in ("instrument/beam", "beam", "sample/beam")
    },
    **{
        f"{where}/incident_wavelength": (
            [(f"{where}/incident_wavelength", WAVELENGTH, "angstrom")], lambda s: s.energy_kev, 25,
        )
        for where in ("instrument/beam", "beam", "sample/beam")
    },
    "instrument/monochromator/energy": ([("instrument/monochromator/energy", 25, "keV")], lambda s: s.energy_kev, 25),
    "instrument/monochromator/wavelength": (
        [("instrument/monochromator/wavelength", WAVELENGTH / 10, "nm")], lambda s: s.energy_kev, 25,
    ),
    "detector/pixel_mask": (
        [("detector/pixel_mask", np.eye(ROWS, COLS, dtype=np.uint32), None)],
        lambda s: np.flatnonzero(s.read([0])[0] == 0).tolist(),
        np.flatnonzero(np.eye(ROWS, COLS)).tolist(),
    ),
    **{
        f"detector/{way}_flipped": (
            [(f"detector/{way}_flipped", True, None)], lambda s: s.attributes["flipped"].split(":")[0], said,
        )
        for way, said in (("x", "left to right"), ("y", "upside down"))
    },
}  # fmt: skip
ENERGY, SAMPLE = "measurement/instrument/monochromator/energy", "measurement/sample/name"
PIXEL = "measurement/instrument/detector"
USED_EXCHANGE: dict[str, tuple[list[tuple[str, Any, str | None]], Callable[[ScanSource], object], Any]] = {
    "implements": ([], lambda s: s.format, "data_exchange"),
    "exchange/data": ([], lambda s: s.shape, (ROWS, COLS)),
    "exchange/data_white": ([], lambda s: int((s.image_key == 1).sum()), 1),
    "exchange/data_dark": ([], lambda s: int((s.image_key == 2).sum()), 1),
    "exchange/theta": ([], lambda s: np.degrees(s.angles[-1]), 144),
    "exchange/title": ([("exchange/title", "a tooth", None)], lambda s: s.attributes["title"], "a tooth"),
    SAMPLE: ([(SAMPLE, "tooth", None)], lambda s: s.attributes["sample"], "tooth"),
    ENERGY: ([(ENERGY, 25.0, "keV")], lambda s: s.energy_kev, 25),
    f"{PIXEL}/x_pixel_size": ([(f"{PIXEL}/x_pixel_size", 6.5, "um")], lambda s: s.pixel_size_mm, 6.5e-3),
    f"{PIXEL}/y_pixel_size": ([(f"{PIXEL}/y_pixel_size", 6.5, "um")], lambda s: s.row_pitch_mm, 6.5e-3),
    f"{PIXEL}/x_binning": (
        [(f"{PIXEL}/x_pixel_size", 6.5e-6, None), (f"{PIXEL}/x_binning", 2, None)], lambda s: s.pixel_size_mm, 13e-3,
    ),
    f"{PIXEL}/y_binning": (
        [(f"{PIXEL}/y_pixel_size", 6.5e-6, "m"), (f"{PIXEL}/y_binning", 2, None)], lambda s: s.row_pitch_mm, 13e-3,
    ),
    f"{PIXEL}/objective/magnification": (
        [(f"{PIXEL}/x_pixel_size", 6.5e-6, "m"), (f"{PIXEL}/objective/magnification", 10, None)],
        lambda s: s.pixel_size_mm,
        0.65e-3,
    ),
}  # fmt: skip
FLAT_FIELDS = "process/acquisition/flat_fields"
DIFFERENT = np.frombuffer(b"Different".ljust(40, b"\0"), np.uint8)[None]
USED_EXCHANGE |= {
    f"{PIXEL}/exposure_time": ([(f"{PIXEL}/exposure_time", [100.0], "ms")], lambda s: s.exposures.tolist(), [0.1] * 7),
    f"{FLAT_FIELDS}/flat_exposure_time": (
        [
            (f"{PIXEL}/exposure_time", 0.1, "s"), (f"{FLAT_FIELDS}/flat_exposure_time", [0.05], None),
            (f"{FLAT_FIELDS}/different_flat_exposure", DIFFERENT, None),
        ],
        lambda s: s.exposures[:3].tolist(), [0.1, 0.05, 0.1],
    ),
    f"{FLAT_FIELDS}/different_flat_exposure": (
        [
            (f"{PIXEL}/exposure_time", 0.1, "s"), (f"{FLAT_FIELDS}/flat_exposure_time", [0.05], "s"),
            (f"{FLAT_FIELDS}/different_flat_exposure", "Same", None),
        ],
        lambda s: s.exposures[:3].tolist(), [0.1, 0.1, 0.1],
    ),
    f"{FLAT_FIELDS}/flat_field_mode": (
        [("exchange/data_white", FRAMES[:2], None), (f"{FLAT_FIELDS}/flat_field_mode", "Both", None)],
        lambda s: s.image_key.tolist(), [2, 1, 0, 0, 0, 0, 0, 1],
    ),
    f"{FLAT_FIELDS}/num_flat_fields": (
        [
            ("exchange/data_white", FRAMES[:2], None), (f"{FLAT_FIELDS}/flat_field_mode", "Both", None),
            (f"{FLAT_FIELDS}/num_flat_fields", 2, None),
        ],
        lambda s: s.image_key.tolist(), [2, 1, 1, 0, 0, 0, 0, 0],
    ),
    "exchange/theta_white": (
        [("exchange/theta_white", [72.0], "deg"), ("exchange/theta_dark", [0.0], "deg")],
        lambda s: s.image_key.tolist(), [2, 0, 0, 1, 0, 0, 0],
    ),
    "exchange/theta_dark": (
        [("exchange/theta_white", [0.0], None), ("exchange/theta_dark", [144.0], None)],
        lambda s: s.image_key.tolist(), [1, 0, 0, 0, 0, 0, 2],
    ),
}  # fmt: skip
TRIED = {"detector/transformations"}  # below


def test_every_row_of_the_lists_is_tried() -> None:
    assert {field.where for field in NXTOMO if field.used} == {*USED_NX} | TRIED
    assert {field.where for field in EXCHANGE if field.used} == {*USED_EXCHANGE}


@pytest.mark.parametrize("where", [*USED_NX, *USED_EXCHANGE])
def test_what_is_used_has_its_value(tmp_path: Path, where: str) -> None:
    store = nxtomo if where in USED_NX else exchange
    changes, found, expected = (USED_NX | USED_EXCHANGE)[where]
    with open_scan(store(tmp_path / "s.h5", *changes)) as source:
        value = found(source)
        assert value == (expected if isinstance(expected, str | tuple | list) else pytest.approx(expected))
        assert not [field for field in source.not_used if field.doubt]


@pytest.mark.parametrize("field", [field for field in NXTOMO if field.units is not None], ids=lambda f: f.where)
def test_a_number_without_a_known_unit_is_named(tmp_path: Path, field: Entry) -> None:
    value = np.full(7, 2.0) if "time" in field.where else 2.0
    for units, said in ((None, "it has no attribute `units`"), ("furlong", "its units 'furlong' are")):
        path = nxtomo(tmp_path / "s.nx", (field.where, value, units))
        (hit,) = [hit for hit in validate(path) if hit.rule == "not-used"]
        assert hit.severity == "warning" and said in hit.message


@pytest.mark.parametrize(
    ("value", "units", "um"),
    [
        *(
            (value, units, 6.5)
            for value in ("6.5", b"6.5 ", ["6.5"], 6.5)
            for units in ("um", "Micrometers", b"\xb5m", "microns.")
        ),
        *((value, None, 6.5) for value in ("6.5 um", "6.5e-3mm", " 6.5E-6 metres ", ".0065 millimeter")),
        ([[6.5]], np.bytes_(b"um \0"), 6.5),
        (6.5e-6, "meters", 6.5),
        ("6.5 um", "mm", None),  # which of the two?
        *((value, "um", None) for value in ("6,5", "about 6.5", "six", "6.5 furlong")),
    ],
)
def test_numbers_in_text_and_units_in_full_are_used_or_named(tmp_path: Path, value: Any, units: Any, um: Any) -> None:
    field = f"{DETECTOR}/x_pixel_size".removeprefix("instrument/")
    value = np.array(value, h5py.string_dtype()) if isinstance(value, list) and value == ["6.5"] else value
    path = nxtomo(tmp_path / "s.nx", (field, value, units))
    with open_scan(path) as source:
        assert source.pixel_size_mm == (None if um is None else pytest.approx(um * 1e-3))
        assert any(each.where == field for each in source.not_used) is (um is None)


@pytest.mark.parametrize(
    ("where", "value"), [(ENERGY, 25.0), (f"{PIXEL}/x_pixel_size", 0.65), (f"{PIXEL}/y_pixel_size", 6.5)]
)
def test_a_number_that_cannot_be_in_the_units_of_the_si_is_named(tmp_path: Path, where: str, value: float) -> None:
    path = exchange(tmp_path / "s.h5", (where, value, None))
    with open_scan(path) as source:
        assert (source.energy_kev, source.pixel_size_mm, source.row_pitch_mm) == (None, None, None)
    assert any(hit.severity == "warning" and where in hit.message for hit in validate(path))


def test_joules_are_the_units_of_data_exchange(tmp_path: Path) -> None:
    for units in ("J", None):
        assert opened(exchange(tmp_path / "s.h5", (ENERGY, 4.00544e-15, units))).energy_kev == pytest.approx(25, 1e-4)


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


@pytest.mark.parametrize("axes", [None, "theta:y:x", "y:theta:x", "y:x:theta", "x:y:theta", "theta:x:y", "x:theta:y"])
def test_frames_in_any_order_of_axes_are_the_same_scan(tmp_path: Path, axes: str | None) -> None:
    with open_scan(exchange(tmp_path / "s.h5", axes=axes)) as source:
        np.testing.assert_array_equal(source.read(slice(None)), FRAMES)
        np.testing.assert_array_equal(source.read([6, 0, 3, 4], slice(1, 3)), FRAMES[[6, 0, 3, 4], 1:3])


def test_axes_that_are_unknown_are_named_and_those_of_nxdata_must_fit(tmp_path: Path) -> None:
    path = exchange(tmp_path / "s.h5")
    with h5py.File(path, "r+") as file:
        file["exchange/data"].attrs["axes"] = "a:b:c"
    (hit,) = [hit for hit in validate(path) if hit.rule == "not-used"]
    assert hit.severity == "warning" and "exchange/data@axes, a:b:c" in hit.message
    with pytest.raises(DataError, match=r"rotation_angle"):
        open_scan(nxtomo(tmp_path / "s.nx", also=_axes))


@pytest.mark.parametrize("height", [0.5, 2.0, 1.01])
def test_pixels_that_are_not_square_are_told(tmp_path: Path, height: float) -> None:
    def said(*more: tuple[str, Any, str | None]) -> list[str]:
        path = nxtomo(tmp_path / "s.nx", ("detector/y_pixel_size", height, "um"), *more)
        assert describe(path)["pixel_height_mm"] == pytest.approx(height * 1e-3)
        return [hit.severity for hit in validate(path) if hit.rule == "pixel-height"]

    assert said() == ["info"]
    assert said(*CONE) == ["error"]


COPIED: dict[str, list[tuple[str, Any, str | None]]] = {
    "a cone": [*CONE, ("instrument/beam/incident_energy", 25.0, "keV")],
    "a distance": [("detector/distance", 0.2, "m")],
    "mirrored": [("detector/x_flipped", True, None), ("detector/y_flipped", True, None)],
}


@pytest.mark.parametrize("changes", COPIED.values(), ids=COPIED.keys())
def test_a_copy_of_ours_states_the_same(tmp_path: Path, changes: list[tuple[str, Any, str | None]]) -> None:
    path = nxtomo(tmp_path / "s.nx", *changes)
    assert ingest(path, tmp_path / "copy.h5").doubts == ()
    with open_scan(path) as source, open_scan(tmp_path / "copy.h5") as copy:
        for name in ("cone", "pixel_size_mm", "energy_kev", "row_pitch_mm"):
            assert getattr(copy, name) == pytest.approx(getattr(source, name)), name
        assert copy.attributes.get("distance_mm") == source.attributes.get("distance_mm")
        np.testing.assert_array_equal(copy.read(slice(None)), source.read(slice(None)))


def test_what_a_copy_cannot_state_is_refused_or_named(tmp_path: Path) -> None:
    path = nxtomo(tmp_path / "s.nx", ("detector/y_pixel_size", 2.0, "um"))
    with pytest.raises(DataError, match=r"0\.001 x 0\.002"):
        ingest(path, tmp_path / "copy.h5")
    assert not (tmp_path / "copy.h5").exists()
    climbs = ("sample/z_translation", np.r_[0, 0, np.arange(VIEWS)] * 1e-6, "m")
    (doubt,) = ingest(nxtomo(tmp_path / "t.nx", climbs), tmp_path / "copy.h5").doubts
    assert "sample/z_translation, 0 to 4e-06 m, which is not used" in doubt


def test_the_page_lists_every_field() -> None:
    page = (Path(__file__).parents[4] / "docs" / "scan_files.md").read_text(encoding="utf-8")
    for field in (*NXTOMO, *EXCHANGE):
        use = field.use if field.used else f"not used{', warned of' if field.matters else ''}: {field.use}"
        assert f"| `{field.where}` | {use} |\n" in page, field.where


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


def test_views_of_two_energies_are_refused_and_one_can_be_chosen(tmp_path: Path) -> None:
    kev = np.r_[np.nan, 20.0, [20, 30, 20, 30, 20]]
    path = nxtomo(tmp_path / "s.nx", ("instrument/beam/incident_energy", kev, "keV"))
    (hit,) = [hit for hit in validate(path) if hit.rule == "energies"]
    assert hit.severity == "error" and "3 at 20 keV, 2 at 30 keV" in hit.message
    with open_scan(SourceOptions(path, frames="energy=20", darks=FRAMES[:2])) as source:
        assert source.energy_kev == 20
        assert source.image_key.tolist() == [2, 2, 3, 1, 0, 3, 0, 3, 0]
    assert not [hit for hit in validate(SourceOptions(path, frames="energy=20")) if hit.rule == "energies"]
    with pytest.raises(DataError, match=r"no frame of .* has this energy; 4 at 20 keV, 2 at 30 keV"):
        open_scan(SourceOptions(path, frames="energy=25"))
    with pytest.raises(DataError, match="states no energy of each frame"):
        open_scan(SourceOptions(nxtomo(tmp_path / "t.nx"), frames="energy=25"))
