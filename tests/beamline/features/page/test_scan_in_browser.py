"""A scan of any format in a real browser, and finding its axis by eye."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.beamline.features.page.chromium import BEAMLINE, MARKS, Browser, browser, canvas_has_picture, page_of
from tests.beamline.scans import TwoCylinders, write_exchange

__all__ = ["browser"]
pytestmark = MARKS
REDRAWN_MS = 300.0


def test_the_slice_follows_the_axis(browser: Browser, tmp_path: Path) -> None:
    wide = TwoCylinders(angles=np.radians(np.arange(0, 180, 0.2)), shape=(1, 2048), axis_col=1020.0)
    with page_of([*BEAMLINE, "view", str(write_exchange(tmp_path / "s.h5", wide)), "--port", "0"], r"(http\S+)") as (
        _,
        address,
    ):
        browser.open(address)
        browser.until(lambda: canvas_has_picture(browser, "fbp"), "the slice is drawn")
        assert "900 x 1 x 2048 pixels" in browser.text("names")
        browser.until(lambda: browser.script("return !!document.getElementById('fbp').dataset.shown"), "it is whole")
        taken = []
        for axis in ("1022", "1025", "1018.5"):
            slider = "document.getElementById('axis-slider')"
            browser.script(f"{slider}.value = {axis}; {slider}.dispatchEvent(new Event('input'))")
            shown = "return document.getElementById('fbp').dataset.shown"
            browser.until(lambda: str(browser.script(shown)).startswith(f"{axis} 0 "), f"axis {axis} is shown")  # noqa: B023
            taken.append(float(str(browser.script(shown)).split()[-1]))
        assert min(taken) < REDRAWN_MS
        assert browser.text("axis-option") == "--axis 1018.5"
        assert browser.complaints() == []
