"""No false alarm: 200 random scans at rest, of one light, break no law; the same with a fault break one."""

from __future__ import annotations

import numpy as np
import pytest

from beamline.projections.selection import Selection
from tests.beamline.array_source import ArraySource, scan_of
from tests.beamline.prepared_views import prepare
from tests.recon.prep.balls import Balls

LAWS = "mass", "centre of mass", "higher or lower", "turn", "as the flats", "noise of the views", "scaled by itself"


def random_scan(seed: int, angles_of: object = None, factor_of: object = None) -> ArraySource:
    """Size, noise, sample, hardening, order, drift of the beam and turn are random."""
    rng = np.random.default_rng(seed)
    n, shape = int(rng.integers(45, 160)), (int(rng.integers(8, 32)), int(rng.integers(48, 112)))
    angles = np.linspace(0, rng.choice([np.pi, 2 * np.pi]), n, endpoint=False)
    true = angles if angles_of is None else angles_of(angles)  # type: ignore[operator]
    axis_col = shape[1] / 2 + rng.uniform(-2, 2)
    balls = Balls(true, shape, axis_col, seed=seed, count=int(rng.integers(2, 30)))
    lines = balls.views().astype(np.float64)
    lines *= rng.uniform(0.7, 2.5) / lines.max()
    lines *= 1 - rng.uniform(0, 0.12) * lines / lines.max()  # hardening
    if factor_of is not None:
        lines *= factor_of(np.arange(n) / n)[:, None, None]  # type: ignore[operator]
    light = np.linspace(1, rng.uniform(0.8, 1.15), n)[:, None, None] * 10 ** rng.uniform(2.8, 4.5)
    order = rng.permutation(n) if rng.random() < 0.2 else np.arange(n)
    beam, start = np.ones((8, *shape)), light[0]
    counts = [rng.poisson(0 * beam), rng.poisson(start * beam), rng.poisson(light * np.exp(-lines[order]))]
    read = (np.clip(np.round(each + rng.normal(100, 1.5, each.shape)), 0, 65535) for each in counts)
    scan = scan_of(*read, angles[order])
    scan.axis_col = axis_col
    return scan


def told(scan: ArraySource) -> list[str]:
    _, sentences = prepare(scan, Selection(axis_col=scan.axis_col))
    return [sentence for sentence in sentences if any(law in sentence for law in LAWS)]


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 200, 25))
def test_scans_at_rest_break_no_law(first: int) -> None:
    assert {seed: said for seed in range(first, first + 25) if (said := told(random_scan(seed)))} == {}


@pytest.mark.parametrize(
    "factor_of",
    [lambda t: 1 - 0.3 * t, lambda t: np.where(t < 0.5, 1, 0.5), lambda t: np.where(np.arange(t.size) % 2, 0.5, 1.0)],
    ids=["evenly", "at once", "in turn"],
)
def test_a_mass_that_changes_is_told(factor_of: object) -> None:
    (sentence,) = told(random_scan(1, factor_of=factor_of))
    assert sentence.startswith("The mass of the views changes by ")
