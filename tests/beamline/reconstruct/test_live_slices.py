"""When slices are drawn during a scan, and what their heading says."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from beamline.reconstruct.snapshots import LiveSlices
from recon.base.geometry import Geometry
from tests.clock import SteppedClock

STEP = np.pi / 180
GOLDEN = np.pi * (np.sqrt(5) - 1) / 2


@dataclass
class Drawn:
    """Stands in for the files of a followed scan."""

    headings: list[str] = field(default_factory=list)

    def write_slices(self, slices: object, n_views: int, heading: str, unseen: object, *below: object) -> None:
        self.headings.append(heading)


def live(angles: np.ndarray) -> tuple[LiveSlices, Drawn, SteppedClock, Any]:
    """The slices, what is drawn, the clock, and the first n views."""
    rng, drawn, clock = np.random.default_rng(0), Drawn(), SteppedClock(tick=0.1)  # drawing takes so long
    source = SimpleNamespace(shape=(3, 16))
    views: Any = SimpleNamespace(
        source=source,
        geometry=lambda col, ids: (Geometry.parallel(angles[ids], source.shape, axis_col=col), {}),
    )

    def first(n: int) -> Any:
        data = rng.uniform(1, 2, (n, *source.shape)).astype(np.float32)
        return (SimpleNamespace(view_ids=np.arange(n), data=data),)

    return LiveSlices(views, drawn, clock), drawn, clock, first  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("step", "n", "heading"),
    [
        (STEP, 63, "FBP of the first 63 projections, sequential: 63 of 180 degrees so far, axis at column 7.0"),
        (STEP, 180, "FBP of the first 180 projections, axis at column 7.0"),
        (GOLDEN, 34, "FBP of the first 34 projections, axis at column 7.0"),
    ],
)
def test_a_heading_says_what_part_of_the_half_turn_is_there(step: float, n: int, heading: str) -> None:
    slices, drawn, _, first = live(np.arange(n) * step)
    slices.draw(first(n), 7.0, 0.0)
    assert drawn.headings == [heading]


def test_they_are_drawn_from_the_eighth_view_on_for_new_views_after_a_pause() -> None:
    slices, drawn, clock, first = live(np.arange(20) * STEP)
    slices.draw(first(7), 7.0, 0.0)
    assert not drawn.headings
    slices.draw(first(8), None, 0.0)
    assert drawn.headings == [
        "FBP of the first 8 projections, sequential: 8 of 180 degrees so far, axis at the detector middle, because the "
        "axis is not known yet; a wrong axis turns edges into crescents (set optics.axis_col or --axis)"
    ]
    clock.time += 1
    slices.draw(first(8), 7.0, 0.0)
    assert len(drawn.headings) == 1
    slices.draw(first(9), 7.0, 0.5)
    slices.draw(first(10), 7.0, 0.5)
    assert len(drawn.headings) == 2
