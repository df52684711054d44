"""Where kinds and angles come from: histories of variables, tomoscan's status, attributes, a PandABox's file."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from fake_ioc import TOMOSCAN, FakeIoc, array_value, counts_of
from ridden import config_of

from beamline.core.errors import ConfigError, DataError
from drivers.base.errors import DeviceTimeout
from drivers.base.frame import FrameKind
from splatline_areadetector.arrays import ArrayFrame, array_frame
from splatline_areadetector.frame_places import BY_ORDER, NO_SCAN, UNKNOWN_KIND, BlockKey
from splatline_areadetector.guides import TomoscanGuide, guide_of, kind_of
from splatline_areadetector.variables import History, Variables, url_problem

CLIENT = """
from caproto.server import PVGroup, pvproperty, run
from caproto import ChannelType
class Group(PVGroup):
    status = pvproperty(value=b"Collecting flat fields", name="ScanStatus", dtype=ChannelType.CHAR, max_length=256)
    kind = pvproperty(value="FlatField", name="FrameType", dtype=ChannelType.ENUM,
                      enum_strings=["DarkField", "FlatField", "Projection"])
    start = pvproperty(value=3.5, name="RotationStart")
run(Group(prefix="C:").pvdb, interfaces=["127.0.0.1"], log_pv_names=False)
"""


def _frame(unique_id: int, seconds: float = 0.0, received: float = 0.0, **attributes: Any) -> ArrayFrame:
    frame = array_frame(array_value(counts_of(1), unique_id, attributes, seconds), received)
    assert frame is not None
    return frame


def test_words_of_kinds() -> None:
    words = {"/exchange/data_white": 1, "DarkField": 2, "Projection": 0, "/exchange/data": 0, "flat": 1}
    assert {word: kind_of(word) for word in words} == {word: FrameKind(n) for word, n in words.items()}
    assert kind_of("bubbles") is None and kind_of(3) is None


def test_a_history_counts_from_the_iocs_times() -> None:
    """What came all at once, as this computer stood still, is in its order; the first value was there before."""
    history = History(lambda: 110.0)
    for stamp, value in ((5.0, "a"), (100.0, "b"), (102.0, "c")):
        history.add(stamp, value)
    assert [[*history.until(seconds)] for seconds in (1, 99, 101, 103)] == [["a"], ["a"], ["a", "b"], ["a", "b", "c"]]
    assert history.delay == 8.0 and history.last == "c" and history.changed_at == 102.0
    counter = History(lambda: 10.0)
    for stamp, number in ((1.0, 5.0), (8.0, 6.0), (9.0, 9.0)):
        counter.add(stamp, number)
    assert counter.rise(7.0, 8.5) == 1.0 and counter.rise(8.5, 9.5) == 3.0
    assert History().rise(0, 1) is None


def test_a_clock_that_was_never_set_is_not_believed() -> None:
    history = History(lambda: 1.7e9)
    history.add(0.0, 1.0)
    history.add(0.0, 2.0)
    assert history.changed_at == 1.7e9


@pytest.mark.usefixtures("loopback")
def test_tomoscans_kinds_although_its_clock_is_half_an_hour_off(tmp_path: Path) -> None:
    with FakeIoc() as ioc:
        ioc.tomoscan(**TOMOSCAN)
        config = config_of(tmp_path, ioc.url, {"from": "tomoscan", "prefix": "pva://T:TomoScan:"}, exposure_s=None)
        guide = guide_of(config.ride)
        assert isinstance(guide, TomoscanGuide)
        assert guide.phase(_frame(1, time.time() - 1800, time.time())) == NO_SCAN and guide.ended(math.inf)
        for status, kind, frame_type in (
            ("Collecting dark fields", FrameKind.DARK, "DarkField"),
            ("Programming PSO", FrameKind.DARK, "DarkField"),
            ("Collecting projections", None, "DarkField"),  # FrameType changes just before the first frame
            ("Collecting projections", FrameKind.PROJECTION, "Projection"),
            ("Aborting scan", None, "Projection"),
        ):
            ioc.tomoscan(ScanStatus=status, FrameType=frame_type)
            time.sleep(0.2)
            now = time.time()
            assert guide.phase(_frame(1, now - 1800, now)).kind is kind
        plan = guide.plan()
        guide.close()
    assert [(block.kind, block.n) for block in plan.blocks] == [(2, 3), (1, 4), (0, 8), (1, 4)]
    assert np.allclose(np.degrees(plan.angles), 10 + 0.5 * np.arange(8))
    assert (plan.exposure(FrameKind.FLAT), plan.exposure(FrameKind.DARK)) == (0.01, 0.03)


@pytest.mark.usefixtures("loopback")
def test_frames_that_a_busy_computer_takes_late_have_the_kinds_of_their_times(tmp_path: Path) -> None:
    """All came late, by times that differ: no other clock, by which a kind would change before its time."""
    with FakeIoc() as ioc:
        ioc.tomoscan(**TOMOSCAN)
        config = config_of(tmp_path, ioc.url, {"from": "tomoscan", "prefix": "pva://T:TomoScan:"}, exposure_s=None)
        guide: Any = guide_of(config.ride)
        for delay in (0.9, 2.5):
            guide.phase(_frame(1, 100.0, 100.0 + delay))
        begin = time.time()
        for n, (status, frame_type) in enumerate((("dark", "DarkField"), ("flat", "FlatField"))):
            ioc.put({"TomoScan:ScanStatus": f"Collecting {status} fields", "TomoScan:FrameType": frame_type}, begin + n)
        deadline, newest = begin + 60, ("Collecting flat fields", "FlatField")
        while (guide.status, guide._variables.text("FrameType")) != newest and time.time() < deadline:
            time.sleep(0.05)
        assert guide.phase(_frame(2, begin + 0.9, begin + 1.9)).kind is FrameKind.DARK
        assert guide.phase(_frame(3, begin + 1.1, begin + 2.1)).kind is FrameKind.FLAT
        guide.close()


def test_kinds_by_order_and_by_attribute(tmp_path: Path) -> None:
    angles = {"from": "attribute", "views": 3}
    guide = guide_of(config_of(tmp_path, "pva://P:I", angles, darks={"count": 2, "at": "both"}).ride)
    assert [block.n for block in guide.plan().blocks] == [2, 3, 2]
    assert guide.phase(_frame(7, SampleRotary=1.0)) == BY_ORDER
    assert guide.angle(_frame(9, SampleRotary=90.0), 0) == pytest.approx(math.pi / 2)
    assert guide.phase(_frame(15)) == guide.phase(_frame(16, SampleRotary=1.0))  # one frame that lacks it ends nothing
    angles_told = [
        guide.angle(_frame(9, **told), 0) for told in ({}, {"SampleRotary": math.inf}, {"SampleRotary": 1e9})
    ]
    assert np.isnan(angles_told).all()
    lacking = guide_of(config_of(tmp_path, "pva://P:I", angles).ride)
    with pytest.raises(
        ConfigError, match=r"The frames have no attribute SampleRotary \(ride.angles.name\); they have ColorM"
    ):
        lacking.phase(_frame(9)), lacking.angle(_frame(9), 0)
    guide = guide_of(config_of(tmp_path, "pva://P:I", angles, kinds="K").ride)
    told = [guide.phase(_frame(i, SampleRotary=1.0, K=word)) for i, word in enumerate(("flat", "data", "x", ""))]
    assert told == [BlockKey(0, FrameKind.FLAT), BlockKey(0, FrameKind.PROJECTION), NO_SCAN, UNKNOWN_KIND]
    assert guide.phase(_frame(9, SampleRotary=1.0)) == UNKNOWN_KIND  # once it was told


def test_a_pandaboxs_file_is_followed(tmp_path: Path) -> None:
    """Row n is trigger n; a row that does not come is no angle."""
    path = tmp_path / "panda.h5"
    angles = {"from": "panda", "views": 4, "file": str(path), "dataset": "/INENC1.VAL.Value", "deg_per_unit": 0.5}
    guide: Any = guide_of(config_of(tmp_path, "pva://P:I", angles).ride)
    guide._wait = 0.5
    with h5py.File(path, "w", libver="latest") as file:
        rows = file.create_dataset("INENC1.VAL.Value", data=[10.0, 20.0], maxshape=(None,), chunks=(16,))
        file.swmr_mode = True
        assert np.degrees(guide.angle(_frame(1), 1)) == pytest.approx(10.0)
        rows.resize(3, 0)
        rows[2] = 30.0
        file.flush()
        assert np.degrees(guide.angle(_frame(1), 2)) == pytest.approx(15.0)
        assert math.isnan(guide.angle(_frame(1), 3))


def _panda(folder: Path, views: int = 20, **angles: Any) -> Any:
    """The guide of a PandABox's file, which waits 0.2 s for what is not there."""
    given = {"from": "panda", "views": views, "file": str(folder / "panda.h5"), **angles}
    guide: Any = guide_of(config_of(folder, "pva://P:I", given).ride)
    guide._wait = 0.2
    return guide


DEGREES = np.linspace(0.0, 171.0, 20)


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (None, "INENC1.VAL.Value does not exist; set ride.angles.dataset to the dataset with"),
        ({}, "is a group; set ride.angles.dataset"),
        (np.array([b"9"] * 20), "holds text, not numbers"),
        (np.ones(20, bool), "holds bool, not numbers"),
        (np.zeros((20, 2)), r"has the shape \(20, 2\), not one number for each trigger"),
        (5.0, r"has the shape \(\), not one number for each trigger"),
        (np.arange(21.0), "has 21 rows, but ride.angles.views is 20. If the file belongs to another"),
        (np.radians(DEGREES), "has steps of 0.1571, which look like radians; set ride.angles.deg_per_unit to 57.29578"),
        (np.linspace(0, 2 * np.pi, 20), "which look like radians"),
        (np.radians(DEGREES[::-1]) + 100, "which look like radians"),
        (np.arange(20) * 5000, "steps of 5000, which look like encoder counts; set ride.angles.deg_per_unit to 360"),
        (np.arange(20) * -50.0, "which look like encoder counts"),
        (np.arange(20) * 1234.5, "which look like encoder counts"),
        (DEGREES + 3.6e6, r"more than 1e\+06 degrees from zero \(positions .* to 3600171\)"),
        (np.full(20, np.nan), "has only 0 positions in its 20 rows"),
        (np.full(20, 7.0), "has the same position in its 20 rows"),
    ],
)  # fmt: skip
def test_a_pandaboxs_file_that_tells_no_angles_is_refused_before_the_scan(
    tmp_path: Path, data: Any, sentence: str
) -> None:
    with h5py.File(tmp_path / "panda.h5", "w") as file:
        if isinstance(data, dict):
            file.create_group("INENC1.VAL.Value")
        elif data is not None:
            file["INENC1.VAL.Value"] = data
    with pytest.raises(ConfigError, match=sentence):
        _panda(tmp_path)


def test_a_file_that_is_no_hdf5_is_refused_before_the_scan(tmp_path: Path) -> None:
    (tmp_path / "panda.h5").write_text("12.5\n")
    with pytest.raises(ConfigError, match=r"panda.h5 cannot be read as HDF5.*Nothing was started"):
        _panda(tmp_path)


@pytest.mark.parametrize(
    ("data", "angles", "ends"),
    [
        (DEGREES, {}, "0° to 171°"),
        (DEGREES[::-1], {}, "171° to 0°"),
        (DEGREES.astype("f4"), {}, "0° to 171°"),
        (9 * np.arange(20), {}, "0° to 171°"),
        (np.radians(DEGREES), {"deg_per_unit": 57.29577951308232}, "0° to 171°"),
        (np.arange(20) * 5000, {"deg_per_unit": 0.0018, "offset_deg": -5}, "-5° to 166°"),
        (DEGREES + 3.6e6, {"offset_deg": -3.6e6}, "0° to 171°"),
        (np.arange(20) * 137.5077, {}, "0° to 2612.65°"),  # golden angles
        (np.radians(DEGREES), {"deg_per_unit": 1}, "0° to 2.98451°"),  # a degree it is, says the configuration
    ],
)
def test_a_pandaboxs_file_that_is_there_says_what_it_has(tmp_path: Path, data: Any, angles: Any, ends: str) -> None:
    with h5py.File(tmp_path / "panda.h5", "w") as file:
        file["INENC1.VAL.Value"] = data
    guide = _panda(tmp_path, **angles)
    assert (
        f"panda.h5 has 20 rows, with angles {ends}. The scan gets these angles, unless the PandABox writes the file "
        "again" in guide.status
    )
    told = [math.degrees(guide.angle(_frame(1), i)) for i in range(20)]
    factor, offset = angles.get("deg_per_unit", 1), angles.get("offset_deg", 0)
    assert np.allclose(told, factor * np.asarray(data, float) + offset, atol=1e-4)


def test_rows_that_are_no_position_and_rows_that_do_not_come_are_no_angle(tmp_path: Path) -> None:
    rows = DEGREES[:15].copy()
    rows[3], rows[7] = np.nan, np.inf
    with h5py.File(tmp_path / "panda.h5", "w") as file:
        file["INENC1.VAL.Value"] = rows
    guide, began = _panda(tmp_path), time.monotonic()
    told = np.degrees([guide.angle(_frame(1), i) for i in range(20)])
    assert np.flatnonzero(np.isnan(told)).tolist() == [3, 7, 15, 16, 17, 18, 19]
    assert time.monotonic() - began < 1.5  # it waits for the first of the rows that do not come, and not for each


def test_a_file_is_read_anew_for_each_scan_and_rows_beyond_its_views_are_left(tmp_path: Path) -> None:
    path, guides = tmp_path / "panda.h5", list[Any]()
    assert _panda(tmp_path).status.endswith("panda.h5 does not exist yet")
    for start in (0.0, 5.0):
        with h5py.File(path, "w") as file:
            file["INENC1.VAL.Value"] = start + DEGREES
        guides = guides or [_panda(tmp_path)]
        guides[0].plan()
        assert math.degrees(guides[0].angle(_frame(1), 2)) == pytest.approx(start + 18)
    with h5py.File(path, "w") as file:
        file["INENC1.VAL.Value"] = DEGREES[:2]
    guides[0].plan()
    with h5py.File(path, "w") as file:  # while frames come, triggers that are nobody's
        file["INENC1.VAL.Value"] = np.arange(30.0) * 9
    assert math.degrees(guides[0].angle(_frame(1), 19)) == pytest.approx(171)
    with pytest.raises(ConfigError, match=r"has 30 rows, but ride\.angles\.views is 20"):
        guides[0].plan()


def test_a_missing_file_is_refused_with_the_first_projection(tmp_path: Path) -> None:
    """It may come after the darks."""
    with pytest.raises(ConfigError, match=r"panda.h5 \(ride.angles.file\) does not exist. Nothing was recorded"):
        _panda(tmp_path).plan()
    given = {"from": "panda", "views": 20, "file": str(tmp_path / "panda.h5")}
    guide: Any = guide_of(config_of(tmp_path, "pva://P:I", given, darks={"count": 2}).ride)
    guide._wait = 0.2
    assert len(guide.plan().blocks) == 2
    with pytest.raises(DataError, match=r"No projection has an angle: .* does not exist\. Earlier frames are in"):
        guide.angle(_frame(1), 0)


@pytest.mark.usefixtures("loopback")
@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"NumAngles": math.inf}, "NumAngles is inf"),
        ({"NumAngles": math.nan}, "NumAngles is nan"),
        ({"NumAngles": 1e9}, r"NumAngles is 1e\+09"),
        ({"NumAngles": -3.0}, "NumAngles is -3"),
        ({"RotationStart": math.inf}, "RotationStart inf"),
        ({"RotationStep": math.nan}, "RotationStep nan"),
        ({"RotationStep": 1e9}, r"RotationStep 1e\+09"),
        ({"NumDarkFields": -3.0}, "NumDarkFields -3"),
        ({"NumFlatFields": 1e9}, r"NumFlatFields 1e\+09"),
        ({"NumFlatFields": math.nan}, "NumFlatFields nan"),
    ],
)
def test_numbers_of_tomoscan_from_which_no_plan_follows(
    tmp_path: Path, changed: dict[str, float], sentence: str
) -> None:
    with FakeIoc() as ioc:
        ioc.tomoscan(**TOMOSCAN | changed)
        guide = guide_of(config_of(tmp_path, ioc.url, {"from": "tomoscan", "prefix": "pva://T:TomoScan:"}).ride)
        with pytest.raises(ConfigError, match=sentence):
            guide.plan()
        guide.close()


@pytest.mark.usefixtures("loopback")
def test_variables_that_do_not_answer() -> None:
    assert url_problem("http://x") and url_problem("ca://") and not url_problem("ca://2bma:")
    with FakeIoc() as ioc:
        ioc.put({"a": 2.5, "b": "text"})
        with Variables("pva://T:", ("a", "b", "c"), ("a",)) as there:
            assert (there.number("a"), there.text("b"), there.number("c"), there.text("c")) == (2.5, "text", None, "")
        with pytest.raises(DeviceTimeout, match="T:c"):
            Variables("pva://T:", ("a", "c"), ("c",))


@pytest.mark.usefixtures("loopback")
def test_variables_by_channel_access_are_closed_when_close_returns(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that ends meanwhile crashes in the library."""
    aioca, closed = pytest.importorskip("aioca"), list[str]()
    close = aioca.Subscription.close

    def slowly(subscription: Any) -> None:
        time.sleep(0.1)
        close(subscription)
        closed.append(subscription.name)

    monkeypatch.setattr(aioca.Subscription, "close", slowly)
    with Variables("ca://NOBODY:", ("a", "b")) as there:
        assert there.number("a") is None
    assert closed == ["NOBODY:a", "NOBODY:b"]


@pytest.mark.slow
def test_text_and_labels_by_channel_access(loopback: dict[str, str]) -> None:
    """tomoscan's ScanStatus is an array of characters."""
    pytest.importorskip("caproto")
    server = subprocess.Popen([sys.executable, "-c", CLIENT])
    try:
        deadline = time.monotonic() + 60
        while True:
            try:
                there = Variables("ca://C:", ("ScanStatus", "FrameType", "RotationStart"), ("ScanStatus", "FrameType"))
                break
            except DeviceTimeout:
                assert time.monotonic() < deadline
        with there:
            assert there.text("ScanStatus") == "Collecting flat fields" and there.text("FrameType") == "FlatField"
            assert there.number("RotationStart") == 3.5
    finally:
        server.kill()
        server.wait()
