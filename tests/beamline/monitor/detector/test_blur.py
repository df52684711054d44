"""The sharpness is that of an analytic edge; projections that lose detail are flagged, others are not."""

from collections.abc import Callable
from math import erf, pi

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, laplace
from scipy.special import erf as erf_of

from beamline.monitor import watch
from beamline.monitor.check import Flag, Level, ScanContext
from beamline.monitor.detector.blur import FAR, STRIP, BlurCheck, sharpness
from beamline.monitor.digest import digest
from drivers.base.frame import Frame, FrameKind

ROWS, COLS, STEP = 48, 128, np.radians(0.5)
OPEN, DARK = 20_000.0, 100.0

Change = Callable[[int, NDArray[np.float64]], NDArray[np.float64]]


def rise(distance: int, sigma: float) -> float:
    """Integral over an edge 0 ... 1 of the squared difference at a distance: of two normal distributions."""
    s = 2 * sigma
    return distance * erf(distance / s) - s / pi**0.5 * (1 - np.exp(-((distance / s) ** 2)))


@pytest.mark.parametrize("sigma", [0.7, 4.0])
def test_the_figure_of_an_edge_is_that_of_its_blur(sigma: float) -> None:
    cols = np.arange(COLS) - 60 - np.repeat(np.linspace(0, 1, 8, endpoint=False), STRIP)[:, None]
    edge = (0.7 + 0.15 * erf_of(cols / sigma / 2**0.5)) * 1e4
    across, down = sharpness(edge.astype(np.uint16), None, np.full(edge.shape, 1e4, np.float32))
    assert across == pytest.approx(4 * rise(FAR // 2, sigma) / rise(FAR, sigma) - 1, rel=0.01)
    assert np.isnan(down)  # the rows of a strip are alike


def test_rows_and_columns_are_told_apart_and_noise_adds_nothing(rng: np.random.Generator) -> None:
    image = gaussian_filter(rng.normal(size=(120, 90)), 1.5)
    image = (1e4 * (1 + 0.2 * image / image.std())).astype(np.float32)
    clean, turned = sharpness(image, None, None), sharpness(np.ascontiguousarray(image.T), None, None)
    noisy = sharpness(image + rng.normal(0, 300, image.shape).astype(np.float32), None, None)
    assert clean == pytest.approx(turned[::-1], rel=0.1)  # the same pixels, by other strips
    assert noisy == pytest.approx(clean, rel=0.1)


def scan(change: Change, views: int = 60, seed: int = 1, photons: float = OPEN) -> list[Flag]:
    """Flags of a turning sample of balls, flat in its light but for `change` of the view's light."""
    rng = np.random.default_rng(seed)
    radius, phase, size = rng.uniform(0, 55, 40), rng.uniform(0, 2 * pi, 40), rng.uniform(2, 6, 40)
    height = rng.uniform(0, ROWS, 40)
    row, col = np.mgrid[:ROWS, :COLS].astype(float)
    monitor, found = watch.start(ScanContext(65535, ROWS * COLS, 0.1), [BlurCheck()]), list[Flag]()
    for i in range(views + 6):
        light = np.zeros((ROWS, COLS))
        kind = FrameKind.DARK if i < 3 else FrameKind.FLAT if i < 6 else FrameKind.PROJECTION
        if i >= 3:
            light += photons * (1 + 0.2 * np.sin(col / 3) * (row > 20))  # the beam's own detail stays
        if i >= 6:
            depth = np.zeros((ROWS, COLS))
            for r, p, s, h in zip(radius, phase, size, height, strict=True):
                at = COLS / 2 + r * np.cos(p + (i - 6) * STEP)
                depth += 0.1 * np.sqrt(np.clip(s**2 - (row - h) ** 2 - (col - at) ** 2, 0, None))
            light *= change(i - 6, gaussian_filter(np.exp(-depth), 0.6))
        counts = (DARK + rng.poisson(light) * (OPEN / photons)).clip(0, 65535).astype(np.uint16)
        angle = (i - 6) * STEP if i >= 6 else np.nan
        frame = Frame(counts, kind, i, max(i - 6, 0), i, angle, 0.1 * i, 0.05)
        monitor, flags = watch.look(monitor, frame, digest(counts, 65535, 4))
        found += flags
    return found


def blurred(first: int, last: int, sigma: float | tuple[float, float]) -> Change:
    return lambda view, light: gaussian_filter(light, sigma) if first <= view < last else light


@pytest.mark.parametrize("sigma", [1.0, 3.0])
def test_views_out_of_focus_are_flagged_and_no_others(sigma: float) -> None:
    flags = scan(blurred(40, 45, sigma))
    assert [flag.frame for flag in flags] == [46, 47, 48, 49, 50]
    assert all(flag.level is Level.WARN and "focus" in flag.advice for flag in flags)


@pytest.mark.parametrize(("sigma", "named"), [((0.0, 1.5), "along the rows"), ((1.5, 0.0), "along the columns")])
def test_motion_during_an_exposure_has_a_direction(sigma: tuple[float, float], named: str) -> None:
    flags = scan(blurred(40, 41, sigma))
    assert [flag.frame for flag in flags] == [46]
    assert named in flags[0].advice


def test_a_slow_loss_of_focus_is_said_once_as_a_fact() -> None:
    flags = scan(lambda view, light: gaussian_filter(light, max(view - 20, 0) / 60), 150)
    facts = [flag for flag in flags if flag.level is Level.INFO]
    assert len(facts) == 1 and "drifts" in facts[0].advice and facts[0].frame > 26


def fringed(view: int, light: NDArray[np.float64]) -> NDArray[np.float64]:
    return light - laplace(light, mode="nearest")


def test_fringes_are_said_once_as_a_fact() -> None:
    flags = scan(fringed, 80)
    assert [flag.level for flag in flags] == [Level.INFO]
    assert flags[0].frame == 37 and "fringes" in flags[0].advice and flags[0].score > 0.01
