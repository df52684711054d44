"""`beamline ride --repeat`: one scan after the other until Ctrl-C, also after a scan with missing frames."""

from __future__ import annotations

import json
import re
import signal
import sys
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from fake_ioc import FakeIoc
from ridden import PLAN, RideProgram, stored

pytestmark = [
    pytest.mark.timeout(600),
    pytest.mark.usefixtures("loopback"),
    pytest.mark.skipif(sys.platform == "win32", reason="no test sends Ctrl-C to one program alone there"),
]
WAITING = "Waiting for the first frame"


@pytest.mark.parametrize(
    ("scans", "in_the_midst", "code", "sentence"),
    [
        ([range(1, 21), range(21, 41)], False, 0, "Recorded: 2 scans; in 0 of these scans, frames are missing."),
        ([range(1, 21), [*range(21, 31), *range(32, 41)], range(41, 61)], False, 5,
         "Recorded: 3 scans; in 1 of these scans, frames are missing. The last of these: 1 of 20 projections is "
         "missing: 10"),
        ([range(1, 21)], True, 4, "Recorded: 1 scan before this one; in 0 of these scans, frames are missing."),
    ],
)  # fmt: skip
def test_scan_after_scan_until_ctrl_c(
    tmp_path: Path, scans: list[range], in_the_midst: bool, code: int, sentence: str
) -> None:
    with FakeIoc() as ioc, RideProgram(tmp_path, ioc.url, "--no-live", "--repeat", angles=PLAN) as ride:
        for n, ids in enumerate(scans, 2):
            ioc.send(ids)
            ride.wait_for(lambda n=n: ride.output.count(WAITING) >= n)  # type: ignore[misc]
        if in_the_midst:
            ioc.send(range(101, 106))
            ride.wait_for(lambda: len([*tmp_path.glob("runs/*/scan.h5")]) == len(scans) + 1)
        ride.process.send_signal(signal.SIGINT)
        assert ride.exit_code() == code, ride.output
        assert sentence in " ".join(ride.output.split())
        assert len(re.findall("^file ", ride.output, re.MULTILINE)) == sum(len(ids) == 20 for ids in scans)
    files = stored(tmp_path)
    assert [file.ids.tolist() for file in files[: len(scans)]] == [[*ids] for ids in scans]
    assert [file.status for file in files[: len(scans)]] == [
        "complete" if len(ids) == 20 else "failed" for ids in scans
    ]


def test_a_scan_that_follows_at_once_keeps_its_first_frames(tmp_path: Path) -> None:
    """The last projection but one was lost, so that the last one waited while the next scan began."""
    with FakeIoc() as ioc, RideProgram(tmp_path, ioc.url, "--no-live", "--repeat", angles=PLAN) as ride:
        for ids in (range(1, 19), range(20, 41)):
            ioc.send(ids)
        ride.wait_for(lambda: ride.output.count(WAITING) >= 3)
        ride.process.send_signal(signal.SIGINT)
        assert ride.exit_code() == 5, ride.output
    one, other = stored(tmp_path)
    assert one.missing == [18] and one.ids.tolist() == [*range(1, 19), 20]
    assert other.ids.tolist() == [*range(21, 41)] and other.degrees.tolist() == [9.0 * i for i in range(20)]


def test_ctrl_c_before_any_scan_says_that_nothing_was_recorded(tmp_path: Path) -> None:
    with FakeIoc() as ioc, RideProgram(tmp_path, ioc.url, "--no-live", "--repeat", angles=PLAN) as ride:
        ride.process.send_signal(signal.SIGINT)
        assert ride.exit_code() == 130 and "Nothing was recorded." in ride.output


def test_the_page_of_all_scans_has_one_address_from_before_the_first(tmp_path: Path) -> None:
    with FakeIoc() as ioc, RideProgram(tmp_path, ioc.url, "--no-live", "--repeat", "--page", angles=PLAN) as ride:
        ride.wait_for(lambda: "Page to control the scan:" in ride.output)
        (look,) = re.findall("Page to watch the scan: (http.*)", ride.output)
        (act,) = re.findall("Page to control the scan: .*#act=(.*)", ride.output)
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        opener.open(look).close()  # its cookie is the token
        base = look.partition("?")[0]

        def table() -> Any:
            with opener.open(f"{base}api/runs") as answer:
                return json.load(answer)

        assert (table()["rows"], table()["newest"]) == ([], None)
        for n, ids in enumerate((range(1, 21), range(21, 41)), 1):
            ioc.send(ids)
            ride.wait_for(lambda n=n: ride.output.count(WAITING) > n)  # type: ignore[misc]
            told = table()
            newest = max((tmp_path / "runs").iterdir(), key=lambda run: run.stat().st_ctime)
            assert len(told["rows"]) == n and told["rows"][0]["cells"][-1] == newest.name
            assert told["newest"] == told["rows"][0]["number"]
            with opener.open(f"{base}run/{told['newest']}/api/facts") as answer:
                facts = json.load(answer)
                assert facts["run"] == newest.name and facts["may_act"] and act
        assert ride.output.count("Page to watch the scan") == 1
        ride.process.send_signal(signal.SIGINT)
        assert ride.exit_code() == 0
