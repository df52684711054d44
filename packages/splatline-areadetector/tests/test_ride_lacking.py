"""`beamline ride` if little arrives: no projection, no frame that can be decoded, no angle for some frames."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from fake_ioc import TOMOSCAN, FakeIoc, array_value, counts_of
from ridden import PLAN, Told, config_of, ride_along, stored

from beamline.core.errors import ConfigError, DataError
from beamline.core.stop import StopRequest
from beamline.scan.ledger import LedgerError

pytestmark = pytest.mark.usefixtures("loopback")
COMPRESSED: dict[str, Any] = {"codec": {"name": "lz4", "parameters": 6}}


def _garbled(unique_id: int) -> Any:
    """16 x 24 pixels that lz4 does not decode."""
    value = array_value(np.full((1, 200), 7, np.uint8), unique_id, **COMPRESSED)
    value.dimension = [{"size": n, "offset": 0, "fullSize": n, "binning": 1, "reverse": False} for n in (24, 16)]
    return value


def _tomoscan(tmp_path: Path, blocks: tuple[tuple[str, str, int], ...]) -> Told:
    def scan(stop: StopRequest) -> None:
        first = 1
        for status, kind, n in blocks:
            ioc.tomoscan(ScanStatus=f"Collecting {status}", FrameType=kind)
            time.sleep(0.1)
            ioc.send(range(first, first + n))
            first += n
            time.sleep(0.1)
        ioc.tomoscan(ScanStatus="Scan complete")

    with FakeIoc() as ioc:
        ioc.tomoscan(**TOMOSCAN)
        angles = {"from": "tomoscan", "prefix": "pva://T:TomoScan:"}
        return ride_along(config_of(tmp_path, ioc.url, angles, exposure_s=None), tmp_path, scan)


@pytest.mark.parametrize(
    "blocks",
    [
        (("flat fields", "FlatField", 4),),
        (("dark fields", "DarkField", 3),),
        (("dark fields", "DarkField", 3), ("flat fields", "FlatField", 4)),
    ],
)
def test_a_scan_without_projections(tmp_path: Path, blocks: tuple[tuple[str, str, int], ...]) -> None:
    told = _tomoscan(tmp_path, blocks)
    n = sum(each for *_, each in blocks)
    assert isinstance(told.error, LedgerError)
    assert "8 of 8 projections are missing: 0-7 (from 10° to 13.5°)" in str(told.error)
    assert str(told.error).endswith(f"The file has {n} frames, but no projection with an angle.")
    (file,) = stored(tmp_path)
    assert file.ids.tolist() == [*range(1, n + 1)] and file.status == "failed"


@pytest.mark.parametrize("whole", [0, 5])
def test_frames_that_cannot_be_decoded_are_told_once(tmp_path: Path, whole: int) -> None:
    def scan(stop: StopRequest) -> None:
        ioc.send(range(1, whole + 1))
        for unique_id in range(whole + 1, 21):
            ioc.post(_garbled(unique_id))
            time.sleep(0.01)

    with FakeIoc() as ioc:
        told = ride_along(config_of(tmp_path, ioc.url), tmp_path, scan)
    if whole:  # of another type: raw and compressed frames are alike
        assert [file.ids.tolist() for file in stored(tmp_path)] == [[*range(1, whole + 1)]]
    assert isinstance(told.error, LedgerError)
    lost = f"{20 - whole} of 20 projections are missing"
    assert lost in str(told.error) and f"{20 - whole} frames arrived ({whole + 1}-20) but could not be used: " in str(
        told.error
    )
    assert told.warnings.count("cannot be decoded") == 1
    (file,) = stored(tmp_path)
    assert len(file.ids) == whole
    if not whole:
        assert str(told.error).endswith("The file has 0 frames, but no projection with an angle.")


def test_an_attribute_that_one_frame_lacks_costs_that_frame_alone(tmp_path: Path) -> None:
    def scan(stop: StopRequest) -> None:
        for unique_id in range(1, 21):
            told = {} if unique_id == 7 else {"SampleRotary": 9.0 * (unique_id - 1)}
            ioc.post(array_value(counts_of(unique_id), unique_id, told))
            time.sleep(0.01)

    with FakeIoc() as ioc:
        told = ride_along(config_of(tmp_path, ioc.url, {"from": "attribute", "views": 20}), tmp_path, scan)
    (file,) = stored(tmp_path)
    assert isinstance(told.error, LedgerError) and "1 of 20 projections is missing: 6" in str(told.error)
    assert "1 frame arrived (7) but could not be used: the attribute SampleRotary with the angle is missing" in (
        str(told.error)
    )
    assert file.kinds.tolist() == [0] * 6 + [3] + [0] * 13 and len(file.ids) == 20
    assert np.allclose(np.delete(file.degrees, 6), np.delete(9.0 * np.arange(20), 6))


def _panda(folder: Path, rows: Any, **angles: Any) -> dict[str, Any]:
    if rows is not None:
        with h5py.File(folder / "panda.h5", "w") as file:
            file["INENC1.VAL.Value"] = rows
    return {"from": "panda", "views": 20, "file": str(folder / "panda.h5"), **angles}


def test_a_pandaboxs_file_with_fewer_rows_than_views(tmp_path: Path) -> None:
    angles = _panda(tmp_path, 9.0 * np.arange(12))
    with FakeIoc() as ioc:
        told = ride_along(config_of(tmp_path, ioc.url, angles), tmp_path, lambda stop: ioc.send(range(1, 21)))
    assert (
        "panda.h5 has 12 rows, with angles 0° to 99°. The scan gets these angles, unless the PandABox writes the "
        "file again." in " ".join(told.before)
    )
    assert isinstance(told.error, LedgerError) and "8 of 20 projections are missing: 12-19" in str(told.error)
    assert "8 frames arrived (13-20) but could not be used: the angle is not known" in str(told.error)
    assert "Now: " in str(told.error) and "panda.h5 has 12 rows" in str(told.error)
    assert told.warnings.count("the angle is not known") == 1
    (file,) = stored(tmp_path)
    assert file.kinds.tolist() == [0] * 12 + [3] * 8 and np.allclose(file.degrees[:12], 9.0 * np.arange(12))


@pytest.mark.parametrize(("rows", "darks"), [(None, 0), (None, 3), (np.radians(9.0 * np.arange(20)), 0)])
def test_a_pandaboxs_file_that_is_missing_or_wrong_is_told_in_one_sentence(
    tmp_path: Path, rows: Any, darks: int
) -> None:
    angles = _panda(tmp_path, rows)
    with FakeIoc() as ioc:
        config = config_of(tmp_path, ioc.url, angles, darks={"count": darks})
        told = ride_along(config, tmp_path, lambda stop: ioc.send(range(1, 24)))
    if rows is not None:
        assert isinstance(told.error, ConfigError) and "look like radians" in str(told.error) and not told.before
    elif not darks:
        assert isinstance(told.error, ConfigError) and "does not exist. Nothing was recorded." in str(told.error)
        assert "Now: " in told.before[0] and "panda.h5 does not exist yet." in told.before[0]
    else:
        assert isinstance(told.error, DataError) and "No projection has an angle: " in str(told.error)
        (file,) = stored(tmp_path)
        assert file.kinds.tolist() == [2] * darks
    assert not told.warnings


def test_a_frame_of_no_pixels_is_refused(tmp_path: Path) -> None:
    value = array_value(counts_of(1), 1)
    value.dimension = [{"size": n, "offset": 0, "fullSize": n, "binning": 1, "reverse": False} for n in (0, 16)]
    with FakeIoc() as ioc:
        told = ride_along(config_of(tmp_path, ioc.url, PLAN), tmp_path, lambda stop: ioc.post(value))
    assert isinstance(told.error, ConfigError) and "the size of the frame is wrong: 16 x 0 pixels of uint16" in str(
        told.error
    )
    assert not stored(tmp_path)
