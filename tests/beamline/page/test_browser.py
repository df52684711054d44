"""The page in a real browser: a scan is watched, paused, resumed and stopped from it; a flag is seen on its frame."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from beamline.monitor.check import Flag, Level
from beamline.monitor.checks import CHECKS
from beamline.scan.control import state_of
from beamline.scan.states import State
from tests.beamline.page.served import served, viewed
from tests.beamline.scans import TwoCylinders, frames_of, write_flagged

selenium = pytest.importorskip("selenium.webdriver")
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(shutil.which("chromium") is None, reason="Chromium is not installed"),
]
WITHIN = 60.0  # s


class Browser:
    """A headless Chromium on one page."""

    def __init__(self) -> None:
        options = selenium.ChromeOptions()
        options.binary_location = shutil.which("chromium")
        for word in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1400,1800"):
            options.add_argument(word)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        service = selenium.ChromeService(shutil.which("chromedriver"))
        self.driver = selenium.Chrome(options=options, service=service)

    def open(self, address: str) -> None:
        """A page; complaints of earlier ones, whose servers have ended, are forgotten."""
        self.driver.get("about:blank")
        self.driver.get_log("browser")
        self.driver.get(address)

    def text(self, name: str) -> str:
        return str(self.driver.find_element("id", name).text)

    def script(self, code: str) -> object:
        return self.driver.execute_script(code)

    def until(self, met: Callable[[], object], what: str) -> None:
        from selenium.webdriver.support.wait import WebDriverWait

        WebDriverWait(self.driver, WITHIN).until(lambda driver: met(), f"{what}; the page says {self.text('status')!r}")

    def click(self, verb: str) -> None:
        self.driver.find_element("css selector", f"[data-verb={verb}]").click()

    def complaints(self) -> list[str]:
        """What the browser itself found wrong, but for pictures that are not there yet and the tests' own readbacks."""
        said = [each["message"] for each in self.driver.get_log("browser")]
        return [each for each in said if not any(word in each for word in ("model.png", "willReadFrequently"))]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    found = Browser()
    yield found
    found.driver.quit()


def canvas_has_picture(browser: Browser, name: str) -> object:
    """The canvas holds more than one grey value."""
    return browser.script(
        f"const c = document.getElementById('{name}'); if (!c) return false;"
        "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        "const greys = new Set(); for (let i = 0; i < d.length; i += 4) greys.add(d[i]); return greys.size > 3;"
    )


def test_a_scan_is_watched_paused_resumed_and_stopped(browser: Browser, tmp_path: Path) -> None:
    command = [
        sys.executable, "-m", "beamline.cli.main", "scan", "configs/simulated.yaml", "--page", "--no-live", "-o",
        str(tmp_path), "--set", "scan.period_s=0.2", "--set", "scan.angles.views=2000",
    ]  # fmt: skip
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as scan:
        assert scan.stderr is not None
        address = next(found[1] for line in scan.stderr if (found := re.search(r"to control: (\S+)", line)))
        browser.open(address)
        assert "token" not in browser.driver.current_url
        assert "act" not in browser.driver.current_url
        browser.until(lambda: browser.text("state") == "acquiring", "the views begin")
        browser.until(lambda: canvas_has_picture(browser, "frame"), "a frame is drawn")
        browser.until(lambda: canvas_has_picture(browser, "sinogram"), "the sinogram is drawn")
        browser.click("pause")
        browser.until(lambda: browser.text("state") == "paused", "the scan pauses")
        browser.click("resume")
        browser.until(lambda: browser.text("state") == "acquiring", "the scan goes on")
        browser.click("stop")
        run = next(tmp_path.iterdir())
        browser.until(lambda: state_of(run) in (State.FINISHING, State.STOPPED), "the scan stops")
        scan.stderr.read()
        assert scan.wait(WITHIN) == 4
    assert state_of(run) is State.STOPPED
    assert browser.complaints() == [] or all("ERR_" in said for said in browser.complaints())  # the server has ended


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


def test_what_a_name_holds_is_text(browser: Browser, tmp_path: Path) -> None:
    evil = "<img src=x onerror=window.evil=1>"
    events = f'{{"event": "warning", "time": 1.0, "message": "{evil}"}}\n'
    (tmp_path / "events.jsonl").write_text(events, encoding="utf-8")
    write_flagged(tmp_path / "scan.h5", frames_of(TwoCylinders()), {})
    with served(tmp_path) as page:
        browser.open(page.addresses.look)
        browser.until(lambda: evil in browser.text("log"), "the warning is in the log")
        assert browser.script("return window.evil === undefined && document.querySelector('#log img') === null")


def test_a_lost_server_is_told(browser: Browser, tmp_path: Path) -> None:
    write_flagged(tmp_path / "scan.h5", frames_of(TwoCylinders()), {})
    with served(tmp_path / "scan.h5") as page:
        browser.open(page.addresses.look)
        browser.until(lambda: canvas_has_picture(browser, "frame"), "a frame is drawn")
    browser.until(lambda: "no connection" in browser.text("state"), "the page says that it has lost the server")


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
        assert browser.complaints() == []
