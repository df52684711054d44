"""rehearse: the checks look at a toy scan, so that their kernels are compiled before the first view comes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np

from beamline.monitor.change import SPAN
from beamline.monitor.check import ScanContext
from beamline.monitor.digest import digests
from beamline.monitor.watch import CheckError, Monitor, look, start
from drivers.base.frame import Frame, FrameKind

_SIDE, _BIN = 256, 8  # pixels of a toy frame, and of a pixel of its preview, whose blocks are joined
_DARK, _FLAT, _SAMPLE = 100, 20_000, 8_000  # counts
_SATURATION, _STEP = 65_535, 0.02  # counts; rad from view to view
_BEFORE_GHOST = 36  # views
_REHEARSED: set[str] = set()  # the checks that this process has rehearsed, as `repr` writes them


def rehearse(monitor: Monitor, begin: Callable[[str], None] = lambda name: None) -> None:
    """Let the checks of a monitor look at a few small frames; the monitor does not change. `begin`: as of `look`.

    numba keeps what it compiles: once on a machine it takes up to a minute, then a fraction of a second, and nothing
    for the next scan of the process with the same checks. A check that fails here will say so in the scan.
    """
    checks = repr(monitor.checks)
    if checks in _REHEARSED:
        return
    # A scan of its own: the views of another step would not be neighbours, and the kernels that compare them not run.
    toy = start(ScanContext(_SATURATION, _SIDE**2, period=0.1, step=_STEP), monitor.checks)
    rng = np.random.default_rng(0)
    kinds = [FrameKind.DARK] * 2 + [FrameKind.FLAT] * 2 + [FrameKind.PROJECTION] * (SPAN + _BEFORE_GHOST)
    x = np.arange(_SIDE) - _SIDE / 2
    for row, kind in enumerate(kinds):
        level = np.full((_SIDE, _SIDE), _DARK if kind is FrameKind.DARK else _FLAT, np.float64)
        if kind is FrameKind.PROJECTION:
            level[:, np.abs(x - 3 * np.sin(_STEP * row)) < _SIDE / 4] = _SAMPLE
            at = 14 * row % _SIDE
            level[100:112, at : at + 12] *= 0.8  # a crumb crosses the field; and at last a ghost
            level *= 1 - 0.2 * np.exp(-(((x + _SIDE / 2 - 14 * (row - _BEFORE_GHOST)) / 30) ** 2))
        counts = rng.poisson(level).astype(np.uint16)
        counts[row, row] = 60_000  # a spot
        frame = Frame(counts, kind, row, row, row, _STEP * row, 1.8e9 + row, 0.1)
        with suppress(CheckError):
            toy, _ = look(toy, frame, digests(counts, _SATURATION, _BIN)[0], begin)
    _REHEARSED.add(checks)
