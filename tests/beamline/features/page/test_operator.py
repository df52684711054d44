"""A first scan as one path: start, see, understand a flag, pause, resume, stop, open a volume, measure."""

from __future__ import annotations

import re
import subprocess
from functools import partial
from pathlib import Path

import pytest

from beamline.scan.control import State, state_of
from tests.beamline.features.page.chromium import (
    BEAMLINE,
    MARKS,
    WITHIN,
    Browser,
    browser,
    canvas_has_picture,
    page_of,
    selenium,
)

__all__ = ["browser"]
pytestmark = MARKS
DIAMETER = 0.2  # mm, of the ball
SCENE = """
phantom:
  kind: solids
  solids: [{kind: cylinder, radius: 0.3, height: 0.6, attenuation: 0.5},
           {kind: ellipsoid, semi_axes: [0.1, 0.1, 0.1], attenuation: 4.0}]
beam: {photons_per_s: 1.0e+5}
detector: {shape: [144, 160]}
effects: [pixel_area, {kind: lost_beam, views: [12, 13], share: 0.02}, photon_noise]
"""


def test_a_first_scan(browser: Browser, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE)
    values = {
        "simulation.scene": tmp_path / "scene.yaml",
        "scan.angles": "{scheme: interlaced, views: 120, passes: 2, start_deg: 10, span_deg: 180}",
        "scan.period_s": 0.15,
        "scan.exposure_s": 0.02,
        "recon.method": "fbp",
    }
    settings = [word for name, value in values.items() for word in ("--set", f"{name}={value}")]
    scan = [*BEAMLINE, "scan", "configs/simulated.yaml", "--page", "-o", str(tmp_path / "runs"), *settings]
    with page_of(scan, r"to control: (\S+)") as (running, address):
        browser.open(address)
        browser.until(lambda: canvas_has_picture(browser, "frame"), "a frame is drawn")
        stored = partial(_frames_stored, browser)
        browser.until(lambda: stored() > 40, "views come")
        browser.until(lambda: "lost (alarm)" in browser.text("log"), "the flag is in the log")
        line = browser.driver.find_element("xpath", "//ol[@id='log']/li[contains(., 'lost (alarm)')]")
        frame = re.findall(r"frame (\d+)", line.text)[0]
        line.find_element("tag name", "button").click()
        browser.until(lambda: browser.text("frame-name").startswith(f"{frame}, projection"), "its frame is shown")
        said = browser.text("frame-flags")
        assert "lost (alarm): the beam is gone" in said
        assert "Check ring current, front end and shutter" in said
        browser.click("pause")
        browser.until(lambda: browser.text("state") == "paused", "the scan pauses")
        browser.click("resume")
        browser.until(lambda: browser.text("state") == "acquiring", "the scan continues")
        browser.until(lambda: stored() > 20 + 60 + 5, "half a turn is full, and the second pass has begun")
        browser.click("stop")
        browser.until(lambda: "This page has ended" in browser.text("said"), "the page says that it ends")
        assert browser.text("state") == "stopped"
        assert "no connection" not in browser.text("status")
        told = browser.text("said").partition("To see the run again: beamline ")[2].split()
        assert running.stdout is not None
        running.stdout.read()
        assert running.wait(WITHIN) == 4
    run = Path(told[1])
    assert (told[0], state_of(run)) == ("watch", State.STOPPED)
    subprocess.run([*BEAMLINE, "recon", str(run / "scan.h5"), "-m", "fbp", "-o", str(run / "recon.h5")], check=True)
    with page_of([*BEAMLINE, *told], r"^watch +(\S+)") as (_, address):
        browser.open(address)
        browser.until(lambda: canvas_has_picture(browser, "slice0"), "the volume is drawn")
        link = browser.driver.find_element("id", "viewer-link").get_attribute("href")
        browser.driver.get(str(link))
        browser.until(lambda: canvas_has_picture(browser, "slice00"), "the viewer draws it")
        browser.driver.find_element("id", "measure").click()  # as on a tablet, without Shift
        ball = browser.driver.find_element("id", "slice00")
        browser.script("document.getElementById('slice00').scrollIntoView({block: 'center'})")
        drag = selenium.ActionChains(browser.driver).move_to_element_with_offset(ball, -75, 0)
        drag.click_and_hold().move_by_offset(150, 0).release().perform()
        browser.until(lambda: "wide at half height" in browser.text("profile-name"), "the ball is measured")
        width = re.search(r"; ([\d.]+) mm wide", browser.text("profile-name"))
        assert width is not None
        assert float(width[1]) == pytest.approx(DIAMETER, abs=0.0046)  # a voxel
        assert browser.complaints() == []


def _frames_stored(browser: Browser) -> int:
    found = re.search(r"(\d+) stored", browser.text("figures"))
    return int(found[1]) if found else 0
