"""The studies, and the projections of a scan that each of their rows uses, as plain values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.base.views import parse_views

COUNTS = 360, 180, 90, 45
SECTORS = ((30, 150, 120), (45, 135, 90), (60, 120, 60))
"""First and last degree of each sector, and number of projections at one per degree: the numbers fall with the width of
the sector."""
EQUAL_COUNTS = 120, 60
DISJOINT_DEG = 1.0, 2.0, 3.0
OVERLAPPING_DEG = 2.0, 3.0, 4.0, 5.0, 6.0
OVERLAPPING = 180  # Number of overlapping windows for each width


@dataclass(frozen=True, eq=False)
class ViewChoice:
    """A selection of projections. Each selected projection is the mean of some projections of the scan.

    Attributes:
        label: its name in tables.
        groups: [projection, window]: the projections of the scan that are averaged; None: the choice is left out.
        family: name that random selections of the same kind share; empty: the choice is not one of several random
            selections. reason: why the choice is left out.
    """

    label: str
    groups: Sequence[Sequence[int]] | None
    family: str = ""
    reason: str = ""

    @property
    def window(self) -> int:
        """Number of projections of the scan that are averaged into one."""
        return len(self.groups[0]) if self.groups else 0

    @property
    def frames(self) -> int:
        """The dose of the choice: number of frames of the scan that it uses, each counted once."""
        return len({view for group in self.groups or () for view in group})

    @property
    def n_views(self) -> int:
        """Number of projections; 0 if the choice is left out."""
        return len(self.groups) if self.groups else 0


@dataclass(frozen=True)
class ViewSet:
    """The projections that a study selects from.

    Attributes:
        angles: [view], radians.
        period: angle in radians after which projections see the same rays, see `Geometry.period`. seed: seed of the
            first random draw. draws: number of random selections for each number of projections.
    """

    angles: NDArray[np.float64]
    period: float
    seed: int = 0
    draws: int = 3


@dataclass(frozen=True)
class Study:
    """A study: a question about a scan, and the rows that answer it.

    Attributes:
        name: on the command line; `title`: of its page.
        rows: all rows. If the scan has too few projections for a row, the row gives the reason.
    """

    name: str
    title: str
    question: str
    rows: Callable[[ViewSet], Sequence[ViewChoice]]


def fixed_views(views: ViewSet) -> list[ViewChoice]:
    """Decreasing numbers of evenly spread projections."""
    return [_fixed(views, n) for n in COUNTS]


def sector(views: ViewSet) -> list[ViewChoice]:
    """Sectors of decreasing width: first with proportionally fewer projections, then all with the same number. The
    whole range is included for comparison."""
    falling = [_sector(views, low, high, n) for low, high, n in SECTORS]
    equal = [_sector(views, low, high, n) for n in EQUAL_COUNTS for low, high, count in SECTORS if n != count]
    return [*(_fixed(views, n) for n in EQUAL_COUNTS), *falling, *equal]


def random(views: ViewSet) -> list[ViewChoice]:
    """Decreasing numbers of projections, evenly spread and selected at random."""
    return [row for n in COUNTS for row in (_fixed(views, n), *_draws(views, n))]


def _draws(views: ViewSet, n: int) -> list[ViewChoice]:
    family = f"random, {n} views"
    if n == views.angles.size:
        return [
            ViewChoice(family, None, family, "these are all projections of the scan, so there is nothing to select")
        ]
    draws = range(views.draws if n < views.angles.size else 1)
    return [_chosen(f"{family}, draw {k + 1}", f"random:{n}:{views.seed + k}", views, family=family) for k in draws]


def window_average(views: ViewSet) -> list[ViewChoice]:
    """Means of neighbouring projections, in windows that do not overlap and in overlapping windows. Single projections
    come first, for comparison."""
    single = [_fixed(views, n) for n in (OVERLAPPING, 90, 60)]
    disjoint = [_windows(views, width, None) for width in DISJOINT_DEG]
    return [*single, *disjoint, *(_windows(views, width, OVERLAPPING) for width in OVERLAPPING_DEG)]


STUDIES = {
    study.name: study
    for study in (
        Study("fixed-views", "Fewer views", "How much is lost with fewer, evenly spread projections?", fixed_views),
        Study(
            "sector",
            "A narrower sector",
            "How much is lost because the range of angles is narrower, and not because there are fewer projections?",
            sector,
        ),
        Study("random", "Views at random", "Are projections at random angles worse than evenly spread ones?", random),
        Study(
            "window-average",
            "Averaged views",
            "What is gained and lost by averaging neighbouring projections?",
            window_average,
        ),
    )
}


def _fixed(views: ViewSet, n: int) -> ViewChoice:
    return _chosen(f"fixed, {n} views", f"fixed:{n}", views)


def _sector(views: ViewSet, low: int, high: int, n: int) -> ViewChoice:
    # Two projections 180° apart see the same rays, mirrored, so a scan that begins at -90 degrees has all of them.
    return _chosen(f"sector {low}-{high}°, {n} views", f"sector:{low}-{high}:{n}", views, within=True)


def _chosen(label: str, spec: str, views: ViewSet, *, within: bool = False, family: str = "") -> ViewChoice:
    """The row for a selection, which is a text for `parse_views`. `within`: True if the angles are first reduced to one
    period."""
    angles = np.mod(views.angles, views.period) if within else views.angles
    try:
        numbers = parse_views(spec, angles, period=views.period)
    except ValueError as error:
        return ViewChoice(label, None, family, str(error))
    return ViewChoice(label, numbers[:, None].tolist(), family)


def _windows(views: ViewSet, width: float, count: int | None) -> ViewChoice:
    """Means over `width` degrees, in `count` evenly spread windows. None: in as many windows as fit without overlap."""
    turn = 2 * np.pi
    angles = views.angles if np.ptp(views.angles) < turn else np.mod(views.angles, turn)
    order = np.argsort(angles, kind="stable")
    step = float(np.median(np.diff(angles[order])))
    w = round(np.radians(width) / step) if step > 0 else 0
    kind = "side by side" if count is None else f"overlapping, {count} views"
    label = f"mean of {w} ({width:g}°), {kind}"
    if w < 2:
        return ViewChoice(
            label, None, reason=(f"the projections are {np.degrees(step):.3g}° apart, so there is nothing to average")
        )
    room = order.size - w + 1
    n = order.size // w if count is None else count
    if n < 2 or n > room:
        return ViewChoice(
            label,
            None,
            reason=(
                f"averaging needs {max(n, 2)} windows of {w} projections, but the {order.size} projections contain "
                f"only "
                f"{max(room, 0)} windows"
            ),
        )
    starts = np.arange(n) * w if count is None else np.linspace(0, room - 1, n).round().astype(np.int64)
    groups = order[starts[:, None] + np.arange(w)]
    together = np.ptp(angles[groups], axis=1) < 2 * np.radians(width)  # no window extends across a gap of the scan
    if together.sum() < 2:
        return ViewChoice(label, None, reason="the projections are spread too unevenly to average neighbours")
    groups = groups[together]
    return ViewChoice(label, groups.tolist())
