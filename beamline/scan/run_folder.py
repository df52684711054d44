"""Run folder: one folder for each run, with fixed file names; logs are created and never appended to later."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import TextIO

from beamline.core.files import CONFIG as CONFIG
from beamline.core.files import OURS
from beamline.core.files import RECON as RECON
from beamline.core.files import SCAN as SCAN

USER_LOG, RECON_LOG = "user.log", "recon.log"
CONTROL, WATCHDOG_LOG = "control", "watchdog.log"
STAMP = "%Y-%m-%dT%H-%M-%S"  # The UTC time at the head of a run folder's name, before "_"


def create_run_folder(runs: Path, sample: str, seconds: float) -> Path:
    """A new folder `<UTC time>_<sample>` in `runs`; where that exists, a number is appended."""
    stem = f"{time.strftime(STAMP, time.gmtime(seconds))}_{sample}"
    runs.mkdir(parents=True, exist_ok=True)
    for number in count(1):
        folder = runs / (stem if number == 1 else f"{stem}-{number}")
        with suppress(FileExistsError):
            folder.mkdir(mode=OURS)
            break
    return folder


@contextmanager
def new_log(path: Path) -> Iterator[TextIO]:
    """A new text file. An error when it is closed (full disk) is ignored: it must not replace the run's own error."""
    file = path.open("x", encoding="utf-8")
    try:
        yield file
    finally:
        with suppress(OSError):
            file.close()
