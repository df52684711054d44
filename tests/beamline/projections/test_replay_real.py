"""Real scans: no alarm on clean ones, their peculiarities are reported, and inserted anomalies are found."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.monitor.check import Flag, Level
from beamline.projections.replay import replay
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import open_scan
from drivers.base.frame import Frame, FrameKind
from tests.slow_cases import others_slow

DIAMOND = "diamond_24737_parallel_91x135x160.h5"
TOOTH = "aps2bm_tooth_181x2x640.h5"

Share = Callable[[int, NDArray[np.float64], NDArray[np.float64]], Any]
"""Light over that of the scan, of view, row and column in pixels."""


@dataclass(frozen=True)
class Changed:
    """A scan whose views have more or less light by place."""

    source: ScanSource
    share: Share

    def __getattr__(self, name: str) -> Any:
        return getattr(self.source, name)

    def read(self, rows: Sequence[int]) -> NDArray[np.float32]:
        row, col = np.mgrid[: self.source.shape[0], : self.source.shape[1]].astype(float)
        images = self.source.read(rows).astype(np.float32)
        for image, at in zip(images, rows, strict=True):
            if self.source.table.kinds[at] == FrameKind.PROJECTION:
                image *= self.share(int((self.source.table.kinds[:at] == FrameKind.PROJECTION).sum()), row, col)
        return images

    def frames(self, first: int = 0) -> Iterator[Frame]:
        for row, frame in enumerate(self.source.frames(first), first):
            yield replace(frame, counts=self.read([row])[0])


def flags(path: Path, share: Share | None = None) -> list[Flag]:
    with open_scan(path) as source:
        seen = source if share is None else Changed(source, share)
        return [flag for judged in replay(seen) for flag in judged.flags]  # type: ignore[arg-type]


def test_a_clean_scan_has_no_flags_but_the_fact_that_it_has_fringes(shared_data: Path) -> None:
    (fact,) = flags(shared_data / TOOTH)
    assert (fact.check, fact.level) == ("blur", Level.INFO) and "fringes" in fact.advice
    assert 0.03 < fact.score < 0.12  # of the edge's step


def test_diamond_has_facts_and_the_crumb_that_crosses_it(shared_data: Path) -> None:
    """Rows 100 to 104, frames 41 to 63, 7 px a view to the right, as a view less its neighbours shows."""
    found = flags(shared_data / DIAMOND)
    facts = {flag.check: flag for flag in found if flag.level is Level.INFO}
    assert facts.keys() == {"beam", "pixels", "field"}
    assert 0.28 <= facts["beam"].score <= 0.34  # the flat is brighter than the open beam: transmission 0.67 to 0.71
    assert "(0, 0)" in facts["pixels"].advice and facts["pixels"].region == (0, 1, 0, 1)
    crumbs = [flag for flag in found if flag.level is not Level.INFO]
    assert {flag.check for flag in crumbs} == {"floater"}
    marked = {frame for flag in crumbs for frame in flag.frames}
    assert marked.issuperset(range(42, 63)) and marked <= set(range(40, 66))
    for flag in crumbs:
        for frame, (top, below, left, right) in flag.regions().items():
            assert top <= 100 and 104 < below <= 112 and left - 8 <= 7.2 * (frame - 41) - 2 <= right + 8
    assert re.search(r"moves 7\.\d px per projection to the right", crumbs[0].advice)


def crumb(view: int, row: NDArray[np.float64], col: NDArray[np.float64]) -> Any:
    at = 8.0 * (view - 40)
    return 1 - 0.1 * np.exp(-0.5 * ((row - 60) ** 2 + (col - at) ** 2) / 3.0**2)


def fog(view: int, row: NDArray[np.float64], col: NDArray[np.float64]) -> Any:
    away = (col - 24.0 * (view - 40)) / 40
    return 1 + 0.1 * np.cos(0.5 * np.pi * np.clip(away, -1, 1)) ** 2


def band(view: int, row: NDArray[np.float64], col: NDArray[np.float64]) -> Any:
    return np.where((row >= 50) & (row < 54) & (40 <= view < 45), 0.0, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("share", "check"), others_slow([(crumb, "floater"), (fog, "ghost"), (band, "bands")]))
def test_what_is_put_into_a_real_scan_is_found(shared_data: Path, share: Share, check: str) -> None:
    own = {(flag.check, flag.frames) for flag in flags(shared_data / DIAMOND)}
    found = [flag for flag in flags(shared_data / DIAMOND, share) if (flag.check, flag.frames) not in own]
    assert check in {flag.check for flag in found}
    assert all(40 <= frame <= 42 + 35 for flag in found for frame in flag.frames)
