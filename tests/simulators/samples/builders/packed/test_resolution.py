"""Resolution pattern: bars, spokes and balls are found in the truth where and as wide as they were asked for."""

from __future__ import annotations

import math
from itertools import groupby
from typing import Any

import numpy as np
import pytest

from recon.base.volume import Grid
from simulators.frame.mapping import SceneError
from simulators.light import Beam
from simulators.samples.builders.packed.resolution import Resolution
from simulators.samples.composed import build_sample
from tests.simulators.bodies import volume

SETTINGS = {"widths_um": (20.0, 10.0), "bars": 3, "star_um": 200.0, "spokes": 12, "balls_um": (40.0, 20.0, 10.0)}


def _sample(**changed: Any):
    return build_sample("phantom", {"kind": "resolution", **SETTINGS} | changed, Beam(1e5))


def _runs(line: np.ndarray) -> list[tuple[int, int]]:
    """(label, voxels) of each stretch of a line."""
    return [(int(label), len(list(run))) for label, run in groupby(line)]


def _solids(role: str) -> list[Any]:
    return [piece.solid for piece in Resolution(**SETTINGS).pieces() if piece.role == role]


def test_bars_and_the_gaps_between_them_are_equally_wide() -> None:
    """A line of voxels of 1 um across each group: bar, gap, bar, gap, bar, upright at y > 0 and lying at y < 0."""
    sample = _sample()
    bar = sample.names.index("bar") + 1
    solids = _solids("bar")
    assert len(solids) == 2 * 2 * 3
    for group, width in enumerate((20, 10)):
        upright = solids[6 * group : 6 * group + 6 : 2]
        lying = solids[6 * group + 1 : 6 * group + 6 : 2]
        x, y, z = upright[1].centre
        across = sample.labels(Grid((1, 1, 7 * width), 1e-3, (z, y, x)))[0, 0]
        assert _runs(across) == [(1, width), (bar, width), (1, width)] + [(bar, width), (1, width)] * 2
        x, y, z = lying[1].centre
        assert y < 0
        up = sample.labels(Grid((7 * width, 1, 1), 1e-3, (z, y, x)))[:, 0, 0]
        assert _runs(up) == [(1, width), (bar, width), (1, width)] + [(bar, width), (1, width)] * 2


def test_the_star_is_half_spokes_at_every_radius() -> None:
    sample = _sample()
    star = sample.names.index("star") + 1
    z = np.mean([corner[2] + solid.centre[2] for solid in _solids("star") for corner in solid.vertices])
    plane = sample.labels(Grid((1, 400, 400), 0.5e-3, (float(z), 0.0, 0.0)))[0]
    for radius in (0.03, 0.06, 0.09):
        turn = (np.arange(2400) + 0.5) / 2400 * 2 * math.pi
        at = [np.rint(radius * f(turn) / 0.5e-3 + 199.5).astype(int) for f in (np.sin, np.cos)]
        ring = plane[tuple(at)] == star
        starts = np.count_nonzero(ring & ~np.roll(ring, 1))
        assert starts == 12
        # A voxel of 0.5 um at each of the 24 edges, of 2 pi r: out by half of one at most.
        assert ring.mean() == pytest.approx(0.5, abs=24 * 0.25e-3 / (2 * math.pi * radius))
    assert not (plane[np.hypot(*np.meshgrid(*[(np.arange(400) - 199.5) * 0.5e-3] * 2)) > 0.1] == star).any()


def test_volumes_of_all_parts_are_those_of_their_solids() -> None:
    sample = _sample()
    pieces = Resolution(**SETTINGS).pieces()
    carrier = pieces[0].solid
    grid = Grid((312, 320, 320), 1e-3)
    assert 2 * carrier.radius < 0.32 and carrier.height < 0.312
    labels = sample.labels(grid)
    for role in ("ball", "star", "bar"):
        counted = (labels == sample.names.index(role) + 1).sum() * 1e-9
        # None is hidden by another, and none sticks out: all of the volume is there.
        assert counted == pytest.approx(sum(volume(solid) for solid in _solids(role)), rel=0.01)
    whole = (labels > 0).sum() * 1e-9
    assert whole == pytest.approx(volume(carrier), rel=0.005)
    radii = [solid.semi_axes[0] for solid in _solids("ball")]
    assert radii == pytest.approx([0.02, 0.01, 0.005])


def test_a_pattern_may_have_one_kind_only() -> None:
    assert _sample(widths_um=[], star_um=0).names == ("carrier", "ball")
    assert _sample(balls_um=[], star_um=0).names == ("carrier", "bar")
    assert _sample(widths_um=[], balls_um=[]).names == ("carrier", "star")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"widths_um": [10, 0]}, r"widths_um\[1\] must be greater than"),
        ({"widths_um": [], "balls_um": [], "star_um": 0}, "needs widths_um"),
        ({"balls_um": [1.0] * 101}, "100 widths and balls at most, got 2 and 101"),
        ({"made_of": {"wedge": "Al"}}, "part of this phantom 'wedge' is unknown"),
    ],
)
def test_wrong_settings_are_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        _sample(**changed)
