"""`beamline ride` with a fake IOC: kinds, angles, missing frames and their cause, ends of files, errors."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_ioc import TOMOSCAN, FakeIoc, array_value, counts_of
from ridden import config_of, ride_along, stored

from beamline.core.errors import ConfigError, DataError, ScanStopped
from beamline.core.stop import ScanAborted, StopRequest
from beamline.scan.ledger import LedgerError
from drivers.base.errors import DeviceTimeout
from drivers.base.frame import FrameKind

pytestmark = pytest.mark.usefixtures("loopback")


def test_every_frame_once_with_its_angle(tmp_path: Path) -> None:
    """The old frame that the server still has is not the scan's."""
    with FakeIoc() as ioc:
        ioc.post(array_value(counts_of(7), 7))
        told = ride_along(config_of(tmp_path, ioc.url), tmp_path, lambda stop: ioc.send(range(1, 30)))
    assert told.error is None
    (file,) = stored(tmp_path)
    assert np.array_equal(file.ids, np.arange(1, 21)) and file.status == "complete" and not file.missing
    assert np.allclose(file.degrees, 9 * np.arange(20)) and (file.kinds == FrameKind.PROJECTION).all()
    assert np.array_equal(file.counts, [counts_of(i) for i in file.ids])


def test_an_exposure_that_changes_during_the_scan_is_that_of_each_frame(tmp_path: Path) -> None:
    def scan(stop: StopRequest) -> None:
        for i in range(1, 21):
            seconds = 0.02 if i < 9 else 0.05
            ioc.put({"cam1:AcquireTime_RBV": seconds})
            ioc.send(range(i, i + 1), attributes={"AcquireTime": seconds})

    with FakeIoc(camera=True) as ioc:
        told = ride_along(config_of(tmp_path, ioc.url, camera="pva://T:cam1:", exposure_s=None), tmp_path, scan)
    assert told.error is None
    (file,) = stored(tmp_path)
    assert np.array_equal(file.ids, np.arange(1, 21)) and np.array_equal(file.counts, [counts_of(i) for i in file.ids])
    assert np.allclose(file.seconds, [0.02] * 8 + [0.05] * 12) and not file.missing


def _tomoscan(ioc: FakeIoc, stop: StopRequest, restarted: bool) -> None:
    """Free run, 3 darks, 4 flats, 8 projections, 4 flats, and free run before tomoscan says that it is complete.

    Args:
        restarted: the camera numbers its frames from 1 in each block, as ADSpinnaker's UniqueIdMode Camera does.
    """
    unique_id = 100

    def block(status: str, kind: str, n: int) -> None:
        nonlocal unique_id
        ioc.tomoscan(ScanStatus=status)
        ioc.tomoscan(FrameType=kind)
        time.sleep(0.02)
        unique_id = 0 if restarted else unique_id
        ioc.send(range(unique_id + 1, unique_id + 1 + n), attributes={"AcquireTime": 0.03 if n == 8 else 0.01})
        unique_id += n
        time.sleep(0.02)

    ioc.send(range(90, 101))
    ioc.tomoscan(ScanStatus="Beginning scan", RotationStep=0.75)
    block("Collecting dark fields", "DarkField", 3)
    block("Collecting flat fields", "FlatField", 4)
    block("Collecting projections", "Projection", 8)
    block("Collecting flat fields", "FlatField", 4)
    ioc.send(range(unique_id + 1, unique_id + 6))
    ioc.tomoscan(ScanStatus="Scan complete")
    ioc.send(range(unique_id + 6, unique_id + 12))


@pytest.mark.parametrize("restarted", [False, True])
def test_tomoscan_tells_kinds_and_angles(tmp_path: Path, restarted: bool) -> None:
    with FakeIoc() as ioc:
        ioc.tomoscan(**TOMOSCAN)
        angles = {"from": "tomoscan", "prefix": "pva://T:TomoScan:"}
        config = config_of(tmp_path, ioc.url, angles, exposure_s=None)
        told = ride_along(config, tmp_path, lambda stop: _tomoscan(ioc, stop, restarted))
    assert told.error is None
    (file,) = stored(tmp_path)
    assert file.kinds.tolist() == [2] * 3 + [1] * 4 + [0] * 8 + [1] * 4 and file.status == "complete"
    assert np.allclose(file.degrees[file.of(0)], 10 + 0.75 * np.arange(8))
    assert np.array_equal(
        file.ids, [*range(1, 4), *range(1, 5), *range(1, 9), *range(1, 5)] if restarted else range(101, 120)
    )
    assert np.allclose(file.seconds, np.where(file.kinds == 0, 0.03, 0.01))
    assert any("outside of a scan" in text for text in told.before)


@pytest.mark.parametrize("first_id", [None, 100])
def test_a_first_projection_that_is_lost_shows_at_the_end_and_it_is_said_that_it_may_be_either(
    tmp_path: Path, first_id: int | None
) -> None:
    def scan(stop: StopRequest) -> None:
        ioc.tomoscan(ScanStatus="Collecting projections")
        time.sleep(0.1)
        ioc.send(range(101, 108), 0.02)  # of 8
        ioc.tomoscan(ScanStatus="Scan complete")

    with FakeIoc() as ioc:
        ioc.tomoscan(**{**TOMOSCAN, "NumDarkFields": 0.0, "NumFlatFields": 0.0})
        angles = {"from": "tomoscan", "prefix": "pva://T:TomoScan:"}
        told = ride_along(config_of(tmp_path, ioc.url, angles, first_id=first_id), tmp_path, scan)
    (file,) = stored(tmp_path)
    assert isinstance(told.error, LedgerError) and file.missing == ([7] if first_id is None else [0])
    undecided = "the missing frame may be the first of the scan. If so, all angles are 0.5° larger than stated"
    assert (undecided in str(told.error)) is (first_id is None)


class _ByChannelAccess(FakeIoc):
    """A fake IOC whose tomoscan is another program, which answers Channel Access."""

    def __init__(self) -> None:
        super().__init__()
        words = [sys.executable, str(Path(__file__).with_name("fake_tomoscan.py")), "C:TomoScan:"]
        self.server = subprocess.Popen(words, stdin=subprocess.PIPE, text=True)

    def tomoscan(self, **values: float | str) -> None:
        assert self.server.stdin is not None
        self.server.stdin.writelines(f"{name}={value}\n" for name, value in values.items())
        self.server.stdin.flush()
        time.sleep(0.3)

    def __exit__(self, *error: object) -> None:
        self.server.kill()
        self.server.communicate()
        super().__exit__(*error)


@pytest.mark.slow
def test_tomoscan_by_channel_access(tmp_path: Path) -> None:
    pytest.importorskip("caproto")
    angles = {"from": "tomoscan", "prefix": "ca://C:TomoScan:"}
    with _ByChannelAccess() as ioc:
        config = config_of(tmp_path, ioc.url, angles, exposure_s=None)
        for _ in range(10):  # until it serves
            told = ride_along(config, tmp_path, lambda stop: _tomoscan(ioc, stop, restarted=False))
            if not isinstance(told.error, DeviceTimeout):
                break
    assert told.error is None
    (file,) = stored(tmp_path)
    assert file.kinds.tolist() == [2] * 3 + [1] * 4 + [0] * 8 + [1] * 4 and file.ids.tolist() == [*range(101, 120)]
    assert np.allclose(file.degrees[file.of(0)], 10 + 0.75 * np.arange(8))


def test_kinds_by_the_attribute_of_the_file_plugin(tmp_path: Path) -> None:
    where = [("data_white", 2), ("data", 20), ("data_dark", 3)]  # darks last
    with FakeIoc() as ioc:

        def scan(stop: StopRequest) -> None:
            first = 1
            for location, n in where:
                ioc.send(range(first, first + n), attributes={"HDF5FrameLocation": f"/exchange/{location}"})
                first += n

        fields = {"flats": {"count": 2, "at": "start"}, "darks": {"count": 3, "at": "end"}}
        config = config_of(tmp_path, ioc.url, kinds="HDF5FrameLocation", **fields)
        assert ride_along(config, tmp_path, scan).error is None
    (file,) = stored(tmp_path)
    assert file.kinds.tolist() == [1] * 2 + [0] * 20 + [2] * 3
    assert np.allclose(file.degrees[file.of(0)], 9 * np.arange(20))


def test_darks_and_flats_by_order_and_from_files(tmp_path: Path) -> None:
    given = {FrameKind.DARK: np.full((2, 16, 24), 100, np.uint16)}
    with FakeIoc() as ioc:
        config = config_of(tmp_path, ioc.url, flats={"count": 3, "at": "both"})
        assert ride_along(config, tmp_path, lambda stop: ioc.send(range(5, 40)), given).error is None
    (file,) = stored(tmp_path)
    assert file.kinds.tolist() == [2] * 2 + [1] * 3 + [0] * 20 + [1] * 3
    assert file.ids.tolist() == [-1] * 2 + [*range(5, 31)] and (file.counts[:2] == 100).all()


def test_lost_frames_are_named_with_whose_loss_it_was(tmp_path: Path) -> None:
    def scan(stop: StopRequest) -> None:
        ioc.send(range(1, 5))
        ioc.put({"Pva1:DroppedArrays_RBV": 2.0})
        ioc.send(range(7, 11), 0.05)
        ioc.put({"Pva1:ArrayCounter_RBV": 20.0})
        ioc.send(range(12, 15), 0.05)
        ioc.put({"Pva1:ArrayCounter_RBV": 21.0})
        ioc.send(range(16, 22), 0.05)

    with FakeIoc() as ioc:
        told = ride_along(config_of(tmp_path, ioc.url), tmp_path, scan)
    assert isinstance(told.error, LedgerError) and told.error.exit_code == 5
    text = str(told.error)
    assert "4 of 20 projections are missing: 4-5, 10, 14 (from 36° to 126°)." in text
    assert "Frames 5-6 were lost by the plugin T:Pva1:, whose queue was full (DroppedArrays rose by 2)." in text
    assert "Frame 11 was lost between the plugin and this program: in the network" in text
    assert "Frame 15 was lost by the camera or its driver, before the plugin T:Pva1:." in text
    (file,) = stored(tmp_path)
    assert file.missing == [4, 5, 10, 14] and np.allclose(file.degrees, 9.0 * (file.ids - 1))


def test_what_is_missing_at_the_end_ends_the_ride_once_the_camera_runs_free(tmp_path: Path) -> None:
    def scan(stop: StopRequest) -> None:
        ioc.send(range(1, 16))
        ioc.put({"Pva1:DroppedArrays_RBV": 5.0})
        ioc.send(range(21, 30), 0.05)

    with FakeIoc() as ioc:
        told = ride_along(config_of(tmp_path, ioc.url), tmp_path, scan)
    assert isinstance(told.error, LedgerError) and "5 of 20 projections are missing: 15-19" in str(told.error)
    assert "Frames 16-20 were lost by the plugin T:Pva1:, whose queue was full (DroppedArrays rose by 5)" in str(
        told.error
    )


def test_a_lower_number_or_another_size_begins_another_file(tmp_path: Path) -> None:
    def scan(stop: StopRequest) -> None:
        ioc.send(range(50, 60))
        ioc.send(range(1, 6))
        for unique_id in range(6, 30):
            ioc.post(array_value(counts_of(unique_id, (8, 24)), unique_id))
            time.sleep(0.01)

    with FakeIoc() as ioc:
        told = ride_along(config_of(tmp_path, ioc.url), tmp_path, scan)
    assert isinstance(told.error, LedgerError)
    assert (
        "frame numbers restarted at 1, after 59 (the server restarted, or the server's counter was reset)"
        in told.warnings
    )
    assert (
        "frames from number 6 on have 8 x 24 pixels of uint16, and earlier frames have 16 x 24 pixels of uint16"
        in told.warnings
    )
    files = stored(tmp_path)
    assert [file.ids.tolist() for file in files] == [[*range(50, 60)], [*range(1, 6)], [*range(6, 26)]]
    assert [file.status for file in files] == ["failed", "failed", "complete"]
    assert all(np.allclose(file.degrees, 9 * np.arange(file.ids.size)) for file in files)


@pytest.mark.parametrize("lost", [0, 2])
def test_the_cameras_count_shows_that_the_first_projections_were_lost(tmp_path: Path, lost: int) -> None:
    def scan(stop: StopRequest) -> None:
        begin = time.time()  # the IOC's times are exact, however late this process sends
        ioc.put({"cam1:NumImagesCounter_RBV": 0.0}, begin)
        for i in range(20):
            if i >= lost:
                ioc.post(array_value(counts_of(100 + i), 100 + i, seconds=begin + 0.1 * i))
            ioc.put({"cam1:NumImagesCounter_RBV": i + 1.0}, begin + 0.1 * i + 0.01)
            time.sleep(0.1)

    with FakeIoc(camera=True) as ioc:
        ioc.put({"cam1:NumImagesCounter_RBV": 40.0})
        told = ride_along(config_of(tmp_path, ioc.url, camera="pva://T:cam1:"), tmp_path, scan)
    (file,) = stored(tmp_path)
    assert np.allclose(file.degrees, 9.0 * (file.ids - 100)) and file.missing == list(range(lost))
    assert ("The camera had counted 2 projections before" in told.warnings) is bool(lost)


def test_a_stop_and_a_stop_before_the_first_frame(tmp_path: Path) -> None:
    def scan(stop: StopRequest) -> None:
        ioc.send(range(1, 8))
        stop.stop("Ctrl-C was pressed")

    with FakeIoc() as ioc:
        told = ride_along(config_of(tmp_path, ioc.url), tmp_path, scan)
        assert isinstance(told.error, ScanStopped) and "Stopped after 7 of 20 projections" in str(told.error)
        told = ride_along(config_of(tmp_path, ioc.url), tmp_path, lambda stop: stop.stop("Ctrl-C was pressed"))
        assert isinstance(told.error, ScanAborted) and "Nothing was recorded" in str(told.error)
    (file,) = stored(tmp_path)
    assert file.status == "stopped" and file.ids.tolist() == [*range(1, 8)]


def _nothing(stop: StopRequest) -> None:
    time.sleep(0.1)


@pytest.mark.parametrize(
    ("records", "ride", "sentence"),
    [
        ({"Pva1:MinCallbackTime_RBV": 0.5}, {}, "MinCallbackTime to 0: it is 0.5 s"),
        (
            {"Pva1:NDArrayPort_RBV": "OVER1"},
            {},
            "sends the frames of OVER1, not those of the camera: overlays may be in the pixels. Set",
        ),
        ({"Pva1:NDArrayPort_RBV": "ROI1"}, {"source": "ROI2"}, "NDArrayPort is ROI1, but ride.source is ROI2"),
    ],
)
def test_settings_that_are_refused(
    tmp_path: Path, records: dict[str, float | str], ride: dict[str, Any], sentence: str
) -> None:
    with FakeIoc() as ioc:
        ioc.put(records)
        told = ride_along(config_of(tmp_path, ioc.url, **ride), tmp_path, _nothing)
    assert isinstance(told.error, ConfigError) and sentence in str(told.error) and not stored(tmp_path)


@pytest.mark.parametrize(
    ("value", "ride", "sentence"),
    [
        (
            {"attributes": {"ColorMode": 2}},
            {},
            "are RGB1, but only single-colour images (Mono) can be stored; set cam1:ColorMode to Mono",
        ),
        ({"counts": np.zeros((4, 4), np.float32)}, {}, "pixels are float32, but they must be uint8 or uint16; set"),
        ({"counts": np.zeros((4, 4), np.int16)}, {}, "pixels are int16"),
        ({"codec": {"name": "jpeg", "parameters": 5}}, {}, "compressed with jpeg, which changes the counts"),
        ({}, {"kinds": "HDF5FrameLocation"}, "The frames have no attribute HDF5FrameLocation (ride.kinds); they have"),
        ({}, {"exposure_s": None}, "exposure time is not known"),
    ],
)
def test_frames_that_are_refused(tmp_path: Path, value: dict[str, Any], ride: dict[str, Any], sentence: str) -> None:
    counts = value.pop("counts", counts_of(1))
    with FakeIoc() as ioc:
        config = config_of(tmp_path, ioc.url, **ride)
        told = ride_along(config, tmp_path, lambda stop: ioc.post(array_value(counts, 1, **value)))
    assert isinstance(told.error, ConfigError | DataError) and sentence in str(told.error) and not stored(tmp_path)


def test_a_camera_that_tells_no_exposure_time_tells_none(tmp_path: Path) -> None:
    with FakeIoc(camera=True) as ioc:
        ioc.put({"cam1:AcquireTime_RBV": 0.0})
        config = config_of(tmp_path, ioc.url, camera="pva://T:cam1:", exposure_s=None)
        told = ride_along(config, tmp_path, lambda stop: ioc.send(range(1, 3)))
    assert "exposure time is not known" in str(told.error) and not stored(tmp_path)


def test_a_binned_stream_is_refused_unless_it_is_named(tmp_path: Path) -> None:
    value = array_value(counts_of(1), 1)
    value.dimension = [{"size": n, "offset": 0, "fullSize": n, "binning": 2, "reverse": False} for n in (24, 16)]
    with FakeIoc(camera=True) as ioc:
        config = config_of(tmp_path, ioc.url, camera="pva://T:cam1:")
        told = ride_along(config, tmp_path, lambda stop: ioc.post(value))
        assert "Frames are binned 2 x 2 by a plugin before" in str(told.error)
        ioc.put({"cam1:BinX_RBV": 2.0})
        assert isinstance(ride_along(config, tmp_path, lambda stop: stop.stop("enough")).error, ScanAborted)


def test_no_server_and_no_frames(tmp_path: Path) -> None:
    told = ride_along(config_of(tmp_path, "pva://T:Pva2:Image"), tmp_path, _nothing)
    assert isinstance(told.error, DeviceTimeout) and "T:Pva2:Image" in str(told.error)
    with FakeIoc(camera=True) as ioc:
        config = config_of(tmp_path, ioc.url, camera="pva://T:cam1:", silence_s=0.2)

        def scan(stop: StopRequest) -> None:
            time.sleep(1)
            stop.stop("enough")

        told = ride_along(config, tmp_path, scan)
    assert "No frame came for 0.2 s, although the server answers: the camera does not acquire" in " ".join(told.before)


def test_tomoscan_without_angles_is_refused(tmp_path: Path) -> None:
    with FakeIoc() as ioc:
        ioc.tomoscan(**TOMOSCAN | {"RotationStep": 0.0})
        angles = {"from": "tomoscan", "prefix": "pva://T:TomoScan:"}

        def scan(stop: StopRequest) -> None:
            ioc.tomoscan(ScanStatus="Collecting projections")
            time.sleep(0.05)
            ioc.send(range(1, 3))

        told = ride_along(config_of(tmp_path, ioc.url, angles), tmp_path, scan)
    assert "no angles: pva://T:TomoScan:NumAngles is 8, RotationStep 0," in str(told.error)
