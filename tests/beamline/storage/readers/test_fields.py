"""Each field of NXtomo and Data Exchange in the lists is used, or named by `info` and `validate`; row by row."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.files.validate import describe, validate
from beamline.projections.selection import Selection
from beamline.projections.views import checked_views, select
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.fields import EXCHANGE, NXTOMO, Entry
from beamline.storage.readers.open import SourceOptions, open_scan
from tests.beamline.storage.readers.foreign_scans import (
    COLS,
    CONE,
    DETECTOR,
    FRAMES,
    KEY,
    ROWS,
    VIEWS,
    exchange,
    nxtomo,
    opened,
)

MATTERS: dict[str, tuple[Any, str | None]] = {  # values of a field that is not used, and that may change the volume
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


UNUSED = [field for field in (*NXTOMO, *EXCHANGE) if not field.used]
Hits = dict[str, list[tuple[str, str]]]


def hits_of(path: Path) -> Hits:
    """Severity and message of each finding on a field that is not used, by the field."""
    hits = Hits()
    for hit in validate(path):
        if hit.rule == "not-used":
            hits.setdefault(hit.message.split("The file states ")[1].split(",")[0], []).append(
                (hit.severity, hit.message)
            )
    return hits


@pytest.fixture(scope="module")
def harmless(tmp_path_factory: pytest.TempPathFactory) -> tuple[Hits, dict[str, str]]:
    """Findings on two files, one of each format, that have all fields that are not used, with values that change
    nothing; and what `info` says of these fields."""
    folder = tmp_path_factory.mktemp("harmless")
    changes = [(field.where, HARMLESS.get(field.where, 0.0), "um") for field in UNUSED]
    paths = [
        nxtomo(folder / "s.nx", *CONE, *(each for each in changes if each[0] in {field.where for field in NXTOMO})),
        exchange(folder / "s.h5", *(each for each in changes if each[0] in {field.where for field in EXCHANGE})),
    ]
    named: dict[str, str] = {}
    for path in paths:
        named |= describe(path)["not_used"]
    return hits_of(paths[0]) | hits_of(paths[1]), named


@pytest.fixture(scope="module")
def mattering(tmp_path_factory: pytest.TempPathFactory) -> Hits:
    """Findings on two files that have all fields that may change the volume."""
    folder = tmp_path_factory.mktemp("mattering")
    nexus = {field.where for field in NXTOMO}
    changes = [(where, *each) for where, each in MATTERS.items()]
    one = nxtomo(folder / "s.nx", *CONE, *(each for each in changes if each[0] in nexus))
    return hits_of(one) | hits_of(exchange(folder / "s.h5", *(each for each in changes if each[0] not in nexus)))


@pytest.mark.parametrize("field", UNUSED, ids=lambda f: f.where)
def test_what_is_not_used_is_named(harmless: tuple[Hits, dict[str, str]], mattering: Hits, field: Entry) -> None:
    hits, named = harmless
    ((severity, message),) = hits[field.where]
    assert severity == "info" and field.use in message
    assert named[field.where].endswith(f"(not used: {field.use})")
    assert (field.matters is not None) == (field.where in MATTERS)
    if field.matters is not None:
        ((severity, message),) = mattering[field.where]
        assert severity == "warning" and field.use in message


PLACES = ("detector", "sample")
WAVELENGTH = 12.39841984 / 25
USED_NX: dict[str, tuple[list[tuple[str, Any, str | None]], Callable[[ScanSource], object], Any]] = {
    "definition": ([("definition", "NXtomo", None)], lambda s: s.format, "nxtomo"),
    "detector/data": ([], lambda s: s.shape, (ROWS, COLS)),
    "detector/image_key": ([], lambda s: s.table.kinds.tolist(), KEY.tolist()),
    "detector/image_key_control": (
        [("detector/image_key_control", np.r_[2, 1, -1, [0] * 4], None)], lambda s: s.table.kinds[2], -1,
    ),
    "detector/count_time": ([("detector/count_time", np.full(7, 20.0), "ms")], lambda s: s.table.exposures[0], 0.02),
    **{f"{of}/x_pixel_size": ([(f"{of}/x_pixel_size", 2.0, "um")], lambda s: s.pixel_size_mm, 2e-3) for of in PLACES},
    **{f"{of}/y_pixel_size": ([(f"{of}/y_pixel_size", 2.0, "um")], lambda s: s.row_pitch_mm, 2e-3) for of in PLACES},
    "detector/distance": ([("detector/distance", 0.2, "m")], lambda s: s.attributes["distance_mm"], 200),
    "instrument/source/distance": (list(CONE), lambda s: s.cone, (10, 20)),
    "sample/rotation_angle": ([], lambda s: np.degrees(s.table.angles[-1]), 144),
    "sample/depends_on": (
        [("sample/depends_on", "rotation_angle", None)],
        lambda s: np.degrees(s.table.angles[-1]),
        144,
    ),
    **{
        where: ([(where, "said", None)], partial(lambda name, s: s.attributes[name], name), "said")
        for where, name in (
            ("sample/name", "sample"), ("title", "title"), ("start_time", "start_time"), ("end_time", "end_time"),
            ("instrument/name", "instrument"),
        )
    },
    "control/data": ([("control/data", np.arange(1.0, 8), None)], lambda s: np.asarray(s.table.currents)[6], 7),
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
            [(f"detector/{way}_flipped", True, None)], lambda s: str(s.attributes["flipped"]).split(":")[0], said,
        )
        for way, said in (("x", "left to right"), ("y", "upside down"))
    },
}  # fmt: skip
ENERGY, SAMPLE = "measurement/instrument/monochromator/energy", "measurement/sample/name"
PIXEL = "measurement/instrument/detector"
USED_EXCHANGE: dict[str, tuple[list[tuple[str, Any, str | None]], Callable[[ScanSource], object], Any]] = {
    "implements": ([], lambda s: s.format, "data_exchange"),
    "exchange/data": ([], lambda s: s.shape, (ROWS, COLS)),
    "exchange/data_white": ([], lambda s: int((s.table.kinds == 1).sum()), 1),
    "exchange/data_dark": ([], lambda s: int((s.table.kinds == 2).sum()), 1),
    "exchange/theta": ([], lambda s: np.degrees(s.table.angles[-1]), 144),
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
    f"{PIXEL}/exposure_time": (
        [(f"{PIXEL}/exposure_time", [100.0], "ms")],
        lambda s: s.table.exposures.tolist(),
        [0.1] * 7,
    ),
    f"{FLAT_FIELDS}/flat_exposure_time": (
        [
            (f"{PIXEL}/exposure_time", 0.1, "s"), (f"{FLAT_FIELDS}/flat_exposure_time", [0.05], None),
            (f"{FLAT_FIELDS}/different_flat_exposure", DIFFERENT, None),
        ],
        lambda s: s.table.exposures[:3].tolist(), [0.1, 0.05, 0.1],
    ),
    f"{FLAT_FIELDS}/different_flat_exposure": (
        [
            (f"{PIXEL}/exposure_time", 0.1, "s"), (f"{FLAT_FIELDS}/flat_exposure_time", [0.05], "s"),
            (f"{FLAT_FIELDS}/different_flat_exposure", "Same", None),
        ],
        lambda s: s.table.exposures[:3].tolist(), [0.1, 0.1, 0.1],
    ),
    f"{FLAT_FIELDS}/flat_field_mode": (
        [("exchange/data_white", FRAMES[:2], None), (f"{FLAT_FIELDS}/flat_field_mode", "Both", None)],
        lambda s: s.table.kinds.tolist(), [2, 1, 0, 0, 0, 0, 0, 1],
    ),
    f"{FLAT_FIELDS}/num_flat_fields": (
        [
            ("exchange/data_white", FRAMES[:2], None), (f"{FLAT_FIELDS}/flat_field_mode", "Both", None),
            (f"{FLAT_FIELDS}/num_flat_fields", 2, None),
        ],
        lambda s: s.table.kinds.tolist(), [2, 1, 1, 0, 0, 0, 0, 0],
    ),
    "exchange/theta_white": (
        [("exchange/theta_white", [72.0], "deg"), ("exchange/theta_dark", [0.0], "deg")],
        lambda s: s.table.kinds.tolist(), [2, 0, 0, 1, 0, 0, 0],
    ),
    "exchange/theta_dark": (
        [("exchange/theta_white", [0.0], None), ("exchange/theta_dark", [144.0], None)],
        lambda s: s.table.kinds.tolist(), [1, 0, 0, 0, 0, 0, 2],
    ),
}  # fmt: skip
TRIED = {"detector/transformations"}  # in test_nexus


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


MEASURED = [field for field in NXTOMO if field.units is not None]


@pytest.fixture(scope="module", params=[(None, "it has no attribute `units`"), ("furlong", "its units 'furlong' are")])
def without_units(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Hits, str]:
    """Findings on a file whose numbers all have no known unit, and what they must say."""
    units, said = request.param
    values = {field.where: np.full(7, 2.0) if "time" in field.where else 2.0 for field in MEASURED}
    changes = [(where, value, units) for where, value in values.items()]
    return hits_of(nxtomo(tmp_path_factory.mktemp("units") / "s.nx", *changes)), said


@pytest.mark.parametrize("field", MEASURED, ids=lambda f: f.where)
def test_a_number_without_a_known_unit_is_named(without_units: tuple[Hits, str], field: Entry) -> None:
    hits, said = without_units
    ((severity, message),) = hits[field.where]
    assert severity == "warning" and said in message


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


def test_the_page_lists_every_field() -> None:
    """Fields of one use share a row."""
    page = (Path(__file__).parents[4] / "docs" / "scan_files.md").read_text(encoding="utf-8")
    rows = re.findall(r"(?m)^\| (`.*`) \| (.*) \|$", page)
    uses = {(name, use) for names, use in rows for name in re.findall("`([^`]+)`", names)}
    for field in (*NXTOMO, *EXCHANGE):
        use = field.use if field.used else f"not used{' (warning)' if field.matters else ''}: {field.use}"
        assert (field.where, use) in uses, field.where


@pytest.mark.parametrize(
    ("value", "units"), [(5.0, "pixels"), (5.0, None), (5e-6, "m"), (5e-3, "mm"), (5.0, "um"), (-2.0, "px")]
)
def test_a_central_ray_beside_the_middle_row_is_told_in_pixels(tmp_path: Path, value: float, units: str | None) -> None:
    told = {
        beam: validate(nxtomo(tmp_path / beam, *also, ("detector/beam_center_y", value, units)))
        for beam, also in (("cone", CONE), ("parallel", ()))
    }
    (hit,) = [hit for hit in told["cone"] if hit.rule == "central-row"]
    assert hit.severity == "warning" and f"--central-row {-2 if value < 0 else 5} " in hit.message
    assert not [hit for hit in told["parallel"] if hit.rule == "central-row"]


def test_a_central_ray_is_counted_as_frames_are_read(tmp_path: Path) -> None:
    flipped = ("detector/y_flipped", True, None), ("detector/beam_center_y", 1.0, None)
    path = nxtomo(tmp_path / "s.nx", *CONE, ("detector/beam_center_x", 4.0, "um"), *flipped)
    assert opened(path).central_ray == (ROWS - 2, pytest.approx(4))
    with open_scan(SourceOptions(path, cols=(1, 6))) as source:
        assert source.central_ray == (ROWS - 2, pytest.approx(3))
    with open_scan(SourceOptions(path, horizontal_axis=True)) as source:
        assert source.central_ray == (pytest.approx(COLS - 1 - 4), ROWS - 2)


@pytest.mark.parametrize("side", "xy")
@pytest.mark.parametrize("n", [VIEWS, VIEWS + 2])
def test_pixel_sizes_that_differ_from_view_to_view(tmp_path: Path, side: str, n: int) -> None:
    def said(spread: float) -> list[str]:
        sizes = np.r_[[9.0] * (n - VIEWS), 6.5 * (1 + spread * np.linspace(-1, 1, VIEWS))]
        path = nxtomo(tmp_path / "s.nx", (f"detector/{side}_pixel_size", sizes, "um"))
        hits = [hit for hit in validate(path) if f"detector/{side}_pixel_size" in hit.message]
        assert all(hit.severity == "error" and "differs between projections" in hit.message for hit in hits)
        return [hit.message for hit in hits]

    assert not said(0.1)  # 0.3 of a pixel at the edge of six columns
    (message,) = said(0.2)
    assert "by up to 0.6 px" in message


@pytest.mark.parametrize("option", [{}, {"pixel_size_mm": 0.0065}])
def test_a_volume_of_sizes_that_differ_is_refused_unless_one_is_said(tmp_path: Path, option: dict[str, float]) -> None:
    sizes = 6.5 * (1 + 0.2 * np.linspace(-1, 1, VIEWS))
    refused = _refused(nxtomo(tmp_path / "s.nx", (f"{DETECTOR}/x_pixel_size", sizes, "um")), Selection(**option))  # type: ignore[arg-type]
    assert ("differs between projections" in refused) == (not option)


@pytest.mark.parametrize("cone", [None, (10.0, 20.0)])
def test_a_scan_is_judged_as_the_beam_that_is_said(tmp_path: Path, cone: tuple[float, float] | None) -> None:
    """High pixels are slices apart in a parallel beam, and refused in a cone."""
    refused = _refused(nxtomo(tmp_path / "s.nx", (f"{DETECTOR}/y_pixel_size", 2e-6, "m")), Selection(cone=cone))
    assert ("a cone beam needs square pixels" in refused) == (cone is not None)


def _refused(path: Path, selection: Selection) -> str:
    """Why `recon` refuses a scan; "" if it does not."""
    with open_scan(path) as source:
        try:
            checked_views(select(source, selection), lambda sentence: None)
        except DataError as error:
            return str(error)
    return ""
