"""Run folder: one folder for each run, with fixed file names; logs are created and never appended to later."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import TextIO

from beamline.core.files import PART

SCAN, RECON, CONFIG = "scan.h5", "recon.h5", "config.resolved.yaml"
EVENTS, USER_LOG, RECON_LOG = "events.jsonl", "user.log", "recon.log"
CONTROL, WATCHDOG_LOG = "control", "watchdog.log"

OURS = 0o755
"""Mode of a folder in which nobody else may put one file in the place of another, whatever the umask."""


def create_run_folder(runs: Path, sample: str, seconds: float) -> Path:
    """A new folder `<UTC time>_<sample>` in `runs`; where that exists, a number is appended."""
    stem = f"{time.strftime('%Y-%m-%dT%H-%M-%S', time.gmtime(seconds))}_{sample}"
    runs.mkdir(parents=True, exist_ok=True)
    for number in count(1):
        folder = runs / (stem if number == 1 else f"{stem}-{number}")
        with suppress(FileExistsError):
            folder.mkdir(mode=OURS)
            break
    return folder


def parts_of(run: Path) -> list[Path]:
    """The folders of a run's parts, in order: its own, and one for each time that it was resumed."""
    return [run, *(part for _, part in sorted(_numbered(run).items()))]


def create_part(run: Path) -> Path:
    """The folder of a new part, after the others."""
    folder = run / PART.format(max(_numbered(run), default=1) + 1)
    folder.mkdir(mode=OURS)
    return folder


def _numbered(run: Path) -> dict[int, Path]:
    found = {part.name.rpartition("-")[2]: part for part in run.glob(PART.format("*"))}
    return {int(number): part for number, part in found.items() if number.isdecimal()}


@contextmanager
def new_log(path: Path) -> Iterator[TextIO]:
    """A new text file. An error when it is closed (full disk) is ignored: it must not replace the run's own error."""
    file = path.open("x", encoding="utf-8")
    try:
        yield file
    finally:
        with suppress(OSError):
            file.close()
