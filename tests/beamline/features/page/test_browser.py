"""The page in a real browser: a scan is watched, paused, resumed and stopped from it; a flag is seen on its frame."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from beamline.monitor.check import Flag, Level
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import digest
from beamline.storage.volumes.base import bare_record
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from beamline.storage.writers.recon_file import write_reconstruction
from drivers.base.clock import SystemClock
from recon.base.volume import VolumeSeries
from tests.beamline.features.page.chromium import (
    BEAMLINE,
    MARKS,
    Browser,
    browser,
    canvas_has_picture,
    page_of,
    selenium,
)
from tests.beamline.features.page.served import listed, served, viewed
from tests.beamline.features.page.test_run_browser import made
from tests.beamline.features.run_folder import asking
from tests.beamline.pass_options import option
from tests.beamline.scans import TwoCylinders, frames_of, write_flagged

__all__ = ["browser"]
pytestmark = MARKS


def test_a_flag_is_found_on_its_frame(browser: Browser, tmp_path: Path) -> None:
    flag = Flag(CHECKS[0].name, Level.ALARM, 12, 0.5, 0.1, "", region=(0, 2, 5, 9))
    write_flagged(tmp_path / "scan.h5", frames_of(TwoCylinders()), {}, flags=[flag])
    with served(tmp_path / "scan.h5") as page:
        browser.open(page.addresses.look)
        browser.until(lambda: "1 of 49" in browser.text("flag-count"), "the flag is counted")
        canvas = browser.driver.find_element("id", "flags")
        canvas.send_keys("\ue012")  # arrow to the left: the flag before the newest frame
        browser.until(lambda: browser.text("frame-name").startswith("12,"), "its frame is shown")
        assert CHECKS[0].name in browser.text("frame-flags")
        browser.until(lambda: canvas_has_picture(browser, "frame"), "it is drawn")
        assert not browser.driver.find_element("id", "verbs").is_displayed()
        assert browser.complaints() == []


NEXT, ENOUGH = option("next", 0.8, (0.6, 1.0), 90, 90.0, 0.125, 2e9), option("enough")
PASS = {"n_views": 90, "options": [NEXT, ENOUGH], "time": 1.7e9}
ENDED = {"event": "pass_ended", "recommended": "next", "wait": 30.0, **PASS}
CHOSEN = {"event": "next_chosen", "choice": "next", "by": "program", "reason": "<b>most a second", **PASS}


def test_what_can_be_measured_next_is_shown_and_chosen(browser: Browser, tmp_path: Path) -> None:
    """Also by a page that is opened late, which learns all from the log."""
    events = [{**ENDED, "number": 1}, {**CHOSEN, "number": 1}, {**ENDED, "number": 2}]
    log = tmp_path / "events.jsonl"
    log.write_text("".join(f"{json.dumps(event)}\n" for event in events), encoding="utf-8")
    find = partial(browser.driver.find_elements, "css selector")
    frames = frames_of(TwoCylinders())
    with NXtomoWriter(tmp_path / "scan.h5", ScanInfo("s"), frames[0].counts.shape, clock=SystemClock()) as writer:
        for frame in frames:
            writer.append(frame, digest(frame.counts), [])
        with asking(tmp_path) as answers, served(tmp_path, control=True) as page:
            browser.open(page.addresses.look)
            browser.until(lambda: "beamline decide CHOICE; after 30 s" in browser.text("passes"), "the scan asks")
            assert find("#passes button") == []
            assert page.addresses.act is not None
            browser.open(page.addresses.act)
            browser.until(lambda: len(find("#passes button")) == 2, "there is a button for each option")
            rows = [row.text for row in find("#passes tbody tr")]
            assert rows == [
                "next: the next pass of the plan +0.80 (0.60 to 1.00) +0.53 90 s 12.5 % 2.00 GB recommended next",
                "enough: no further pass +0.00 - 0 s 0.0 % 0 MB enough",
                "1 next program +0.80 – <b>most a second",
            ]
            find("#passes button")[1].click()
            browser.until(lambda: answers == ["enough"], "the answer reaches the scan")
            chosen = {**CHOSEN, "number": 2, "choice": "enough", "by": "operator", "predicted": 0.8, "gained": 0.7}
            with log.open("a", encoding="utf-8") as file:
                file.write(json.dumps(chosen) + "\n")
            browser.until(lambda: find("#passes button") == [], "it asks no more")
            rows = [row.text for row in find("#passes .decisions tbody tr")]
            assert rows == ["2 enough operator +0.00 – <b>most a second", "1 next program +0.80 +0.70 <b>most a second"]
            assert browser.complaints() == []


def test_a_pause_that_was_sent_is_taken_back(browser: Browser, tmp_path: Path) -> None:
    """Also while the scan waits for its live volume, where it cannot pause yet."""
    waits = {"event": "state", "time": 1.7e9, "state": "flats", "message": "Waiting until the fit is ready"}
    (tmp_path / "events.jsonl").write_text(f"{json.dumps(waits)}\n", encoding="utf-8")
    frames = frames_of(TwoCylinders())
    with NXtomoWriter(tmp_path / "scan.h5", ScanInfo("s"), frames[0].counts.shape, clock=SystemClock()) as writer:
        for frame in frames:
            writer.append(frame, digest(frame.counts), [])
        with asking(tmp_path), served(tmp_path, control=True) as page:
            assert page.addresses.act is not None
            browser.open(page.addresses.act)
            resume = browser.driver.find_element("css selector", "[data-verb=resume]")
            browser.until(lambda: browser.text("state") == "flats", "the scan waits")
            assert browser.text("message") == waits["message"] and not resume.is_enabled()
            browser.click("pause")
            browser.until(lambda: browser.text("state") == "flats, pause sent", "the pause is sent")
            assert "Resume takes the pause back" in browser.text("said")
            browser.until(resume.is_enabled, "it can be taken back")
            browser.click("resume")
            browser.until(lambda: browser.text("state") == "flats" and not browser.text("said"), "it is taken back")
            assert browser.complaints() == []


def test_a_lost_server_is_told(browser: Browser, tmp_path: Path) -> None:
    write_flagged(tmp_path / "scan.h5", frames_of(TwoCylinders()), {})
    with page_of([*BEAMLINE, "watch", str(tmp_path / "scan.h5")], r"^watch +(\S+)") as (_, address):
        browser.open(address)
        browser.until(lambda: canvas_has_picture(browser, "frame"), "a frame is drawn")
    browser.until(lambda: "no connection" in browser.text("state"), "the page says that it has lost the server")
    assert f"beamline watch {tmp_path / 'scan.h5'}" in browser.text("said")


def test_two_volumes_are_compared(browser: Browser, tmp_path: Path) -> None:
    ramp = np.arange(4000, dtype=np.float32).reshape(10, 20, 20)
    for name, values in {"first.npy": ramp, "second.npy": ramp + 7 * (ramp > 2000)}.items():
        np.save(tmp_path / name, values)
    with viewed(tmp_path / "first.npy", tmp_path / "second.npy") as page:
        browser.open(page.addresses.look)
        for row in range(3):
            for axis in range(3):
                browser.until(partial(canvas_has_picture, browser, f"slice{row}{axis}"), f"slice {row} {axis} is drawn")
        drawn_in = partial(browser.driver.find_elements, "css selector")
        browser.until(partial(drawn_in, "#histogram canvas"), "the histogram is drawn")
        first = browser.driver.find_element("id", "slice00")
        line = selenium.ActionChains(browser.driver).key_down("\ue008")
        line.move_to_element_with_offset(first, -60, 0).click_and_hold().move_by_offset(120, 10).release().key_up(
            "\ue008"
        ).perform()
        browser.until(partial(drawn_in, "#profile canvas"), "the profile is drawn")
        first.send_keys("\ue00e")  # Page Up
        browser.until(lambda: browser.text("where0") == "6", "the next slice")
        before = browser.text("window")
        browser.script("[...document.querySelectorAll('#window button')].at(-1).click()")
        browser.until(lambda: browser.text("window") != before, "the window of these percentiles")
        assert browser.complaints() == []


def test_a_series_in_time_is_played(browser: Browser, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    volumes = np.stack([np.full((6, 8, 10), k, np.float32) for k in range(3)]) + rng.random((3, 6, 8, 10), np.float32)
    series = VolumeSeries(np.array([0.0, 1.5, 3.0]), volumes)
    first = bare_record(tmp_path, volumes[0], (1.0, 1.0, 1.0))
    write_reconstruction(tmp_path / "series.h5", replace(first, series=series, parameters={"method": "series"}))
    with viewed(tmp_path / "series.h5") as page:
        browser.open(page.addresses.look)
        browser.until(lambda: canvas_has_picture(browser, "slice00"), "a slice is drawn")
        assert (browser.text("when"), browser.text("play")) == ("0 s", "Play")
        body = browser.driver.find_element("tag name", "body")
        body.send_keys(".")
        browser.until(lambda: browser.text("when") == "1.5 s", "a step is shown")
        assert browser.script("return document.getElementById('play').textContent") == "Play"
        mean = (
            "const c = document.getElementById('slice00'), d = c.getContext('2d').getImageData(0, 0, c.width, c.height)"
        )
        mean += ".data; let s = 0; for (let i = 0; i < d.length; i += 4) s += d[i]; return s * 4 / d.length;"
        middle = float(str(browser.script(mean)))
        body.send_keys(",")
        browser.until(lambda: float(str(browser.script(mean))) < middle, "the first time is darker in the same window")
        body.send_keys(" ")
        assert browser.text("play") == "Pause"
        browser.until(lambda: browser.text("when") == "3 s", "it plays to the end")
        browser.until(lambda: browser.text("when") == "0 s", "and begins again")
        browser.driver.find_element("id", "play").click()
        assert browser.text("play") == "Play"
        assert browser.complaints() == []


def test_a_run_is_found_in_the_table_and_opened(browser: Browser, tmp_path: Path) -> None:
    for day in range(1, 9):
        made(tmp_path, day, f"sample {day}" if day < 8 else "<img src=x onerror=window.evil=1>")
    with listed(tmp_path) as page:
        browser.open(page.addresses.look)
        find = partial(browser.driver.find_elements, "css selector")
        browser.until(lambda: len(find("tbody tr")) == 8, "the runs are listed")
        assert "<img" in find("tbody td:nth-child(2)")[0].text
        assert browser.script("return window.evil === undefined && document.querySelector('td img') === null")
        links = [link.get_attribute("href") for link in find("tbody a")]
        table = browser.driver.current_window_handle
        for link in links:  # more tabs than a browser has connections to one server
            browser.driver.switch_to.new_window("tab")
            browser.driver.get(link)
            browser.until(lambda: canvas_has_picture(browser, "frame"), "a frame is drawn")
        assert browser.text("run").startswith("20260101")
        assert browser.complaints() == []
        for handle in set(browser.driver.window_handles) - {table}:
            browser.driver.switch_to.window(handle)
            browser.driver.close()
        browser.driver.switch_to.window(table)
