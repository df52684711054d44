"""A headless Chromium for the tests of the page; a module that imports this one is skipped if selenium is not
installed."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

selenium = pytest.importorskip("selenium.webdriver")
MARKS = [
    pytest.mark.browser,
    pytest.mark.skipif(shutil.which("chromium") is None, reason="Chromium is not installed"),
]
WITHIN = 60.0  # s
BEAMLINE = [sys.executable, "-m", "beamline.cli.main"]


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
        """Open a page; errors of earlier pages, whose servers have ended, are discarded."""
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
        """Errors that the browser found, except pictures that do not exist yet and the tests' own readbacks."""
        said = [each["message"] for each in self.driver.get_log("browser")]
        return [each for each in said if not any(word in each for word in ("model.png", "willReadFrequently"))]


@contextmanager
def page_of(command: list[str], address: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start a command that serves a page; returns it and the address that it prints after `address`."""
    with subprocess.Popen(command, stderr=subprocess.STDOUT, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        try:
            yield running, next(found[1] for line in running.stdout if (found := re.search(address, line)))
        finally:
            running.kill()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    found = Browser()
    yield found
    found.driver.quit()


def canvas_has_picture(browser: Browser, name: str) -> object:
    """Whether the canvas contains more than one grey value."""
    return browser.script(
        f"const c = document.getElementById('{name}'); if (!c || !c.width) return false;"
        "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        "const greys = new Set(); for (let i = 0; i < d.length; i += 4) greys.add(d[i]); return greys.size > 3;"
    )
