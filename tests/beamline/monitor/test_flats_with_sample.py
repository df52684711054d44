"""One group of flats with the sample in the beam is detected from the projections, whatever the sample.

Scans of balls by the formula of a sphere's chord, with photon noise, a beam with a profile, and stripes that drift.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from beamline.storage.rules import Finding
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.light import references_usable
from tests.beamline.array_source import ArraySource

ROWS, COLS, VIEWS, FLATS, LIGHT = 16, 96, 32, 4, 3e4
DARK = 100.0

Balls = list[tuple[float, float, float, float, float]]  # x, y, z, radius in px, and attenuation a px
SOLID: Balls = [(0, 0, 0, 30, 0.004), (13, 6, 1, 7, 0.03), (-12, 10, -2, 6, 0.02), (-9, -15, 3, 5, 0.06)]
WEAK: Balls = [(*ball, mu / 4) for *ball, mu in SOLID]  # type: ignore[misc]
OFF: Balls = [(9, 5, 0, 14, 0.01)]
ROUND: Balls = [(0, 0, 0, 25, 0.01)]
WIDE: Balls = [(0, 0, 0, 86, 0.004), (60, 10, 0, 12, 0.03)]


def depth(balls: Balls, angles: NDArray[np.float64], moved: float = 0.0) -> NDArray[np.float64]:
    """Line integrals [view, row, col]."""
    row, col = np.arange(ROWS) - (ROWS - 1) / 2, np.arange(COLS) - (COLS - 1) / 2 - moved
    found = np.zeros((angles.size, ROWS, COLS))
    for x, y, z, radius, mu in balls:
        at = x * np.cos(angles) + y * np.sin(angles)
        squares = radius**2 - (col - at[:, None, None]) ** 2 - (row[:, None] - z) ** 2
        found += 2 * mu * np.sqrt(squares.clip(0))
    return found


def scan(balls: Balls, in_flats: NDArray[np.float64], drift: float = 0.0, seed: int = 0) -> ArraySource:
    """Flats before half a turn, with these line integrals in the beam; stripes of 5 % move by `drift` radians."""
    rng = np.random.default_rng(seed)
    angles = np.arange(VIEWS) * np.pi / VIEWS
    x, y = np.linspace(-1, 1, COLS), np.linspace(-1, 1, ROWS)[:, None]

    def beam(time: NDArray[np.float64]) -> NDArray[np.float64]:
        phase = drift * time[:, None, None]
        return LIGHT * np.exp(-0.3 * x**2 - 0.4 * y**2) * (1 + 0.05 * np.sin(20 * y + phase)) * (1 - 0.02 * phase)

    flats = beam(np.zeros(FLATS)) * np.exp(-in_flats)
    views = beam((1 + np.arange(VIEWS)) / VIEWS) * np.exp(-depth(balls, angles))
    counts = np.concatenate([np.zeros_like(flats), flats, views]) + DARK
    keys = [2] * FLATS + [1] * FLATS + [0] * VIEWS
    return ArraySource(rng.poisson(counts).astype(np.uint16), keys, np.r_[np.full(2 * FLATS, np.nan), angles])


def told(source: ArraySource) -> list[Finding]:
    return list(references_usable(ScanEvidence(source)))


@pytest.mark.parametrize(
    ("balls", "degrees", "moved", "said"),
    [
        (SOLID, 300.0, 0.0, "projections are locally brighter"),  # the angle of no view: only its mirror image is there
        (WEAK, 300.0, 0.0, "projections show that the sample absorbs at least"),
        (OFF, 227.0, 0.0, "the sample was in the beam"),
        (SOLID, 0.0, 14.0, "the sample was in the beam"),
        (ROUND, 0.0, 14.0, "projections are locally brighter"),
        (OFF, 45.0, -30.0, "the sample was in the beam"),
    ],
)
@pytest.mark.parametrize("drift", [0.0, 0.5])
def test_a_single_group_of_flats_with_the_sample_in_is_refused(
    balls: Balls, degrees: float, moved: float, said: str, drift: float
) -> None:
    (hit,) = told(scan(balls, depth(balls, np.radians([degrees]), moved)[0], drift))
    assert (hit.severity, hit.rule) == ("error", "bad-references")
    assert hit.message.startswith("Flats in frames 4-7: ") and said in hit.message


def test_views_that_show_nothing_beside_their_flats_are_named() -> None:
    """A round sample that was never moved out, and no sample at all, cannot be told apart."""
    for balls in (ROUND, []):
        (hit,) = told(scan(balls, depth(balls, np.zeros(1))[0] if balls else np.zeros((ROWS, COLS))))
        assert hit.severity == "warning" and "differ from the flats only by noise" in hit.message


@pytest.mark.slow
@given(
    st.lists(
        st.tuples(st.floats(0, 1), st.floats(0, 6.28), st.floats(-6, 6), st.floats(3, 18), st.floats(0.1, 3)),
        min_size=1, max_size=4,
    ),
    st.one_of(st.none(), st.floats(50, 110)), st.floats(0, 0.5), st.integers(0, 99),
)  # fmt: skip
def test_flats_without_the_sample_are_used(
    shapes: list[tuple[float, ...]], around: float | None, drift: float, seed: int
) -> None:
    """Whatever balls there are, the field may cut them off, too, or lie within a larger one."""
    balls = [(far * 46 * np.cos(at), far * 46 * np.sin(at), z, r, most / (2 * r)) for far, at, z, r, most in shapes]
    balls += [] if around is None else [(0, 0, 0, around, 0.25 / around)]
    assert told(scan(balls, np.zeros((ROWS, COLS)), drift, seed)) == []
