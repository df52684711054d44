"""Angle plans: which views to take, in which order, and which again after the last one; float64 [view] in radians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beamline.plan.plan import Block, Mode
from drivers.base.frame import FrameKind
from recon.base.views import spread

GOLDEN = (math.sqrt(5) - 1) / 2
"""The golden section; modulo one, its multiples stay spread at every length (three-gap theorem, Sós 1957)."""


def _require(views: int) -> None:
    if views < 1:
        raise ValueError(f"a plan needs at least 1 view(s), got {views}")


def fixed(views: int, start: float = 0.0, span: float = math.pi) -> NDArray[np.float64]:
    """Equal steps of span / views from `start`; the end is excluded, because it is the start again (or its mirror).

    A negative span turns the other way.
    """
    _require(views)
    return start + np.arange(views, dtype=np.float64) * (span / views)


def sector(views: int, first: float, last: float) -> NDArray[np.float64]:
    """Equal steps from `first` to `last`, both included: a limited-angle scan. One view stands at `first`."""
    _require(views)
    return np.linspace(first, last, views)


def random(views: int, start: float = 0.0, span: float = math.pi, *, rng: np.random.Generator) -> NDArray[np.float64]:
    """Uniformly random over [start, start + span), sorted along the span, so that the stage passes it once."""
    _require(views)
    return start + span * np.sort(rng.random(views))


def pass_order(passes: int) -> NDArray[np.intp]:
    """The order in which the gaps of the first pass are filled: a permutation of 0 ... passes - 1.

    Bit reversal (Mohan et al. 2015, TIMBIR) of the next power of two, without the values that `passes` does not reach.
    So each pass falls near the middle of the largest gap that is left, for any number of passes.
    """
    _require(passes)
    bits = (passes - 1).bit_length()
    values = np.arange(1 << bits)
    reversed_bits = sum((((values >> bit) & 1) << (bits - 1 - bit) for bit in range(bits)), np.zeros_like(values))
    return reversed_bits[reversed_bits < passes].astype(np.intp)


def interlaced(views: int, passes: int, start: float = 0.0, span: float = math.pi) -> NDArray[np.float64]:
    """The `fixed` angles in `passes` sweeps of the span; each sweep goes the same way and takes every passes-th view.

    One direction for all sweeps, because a motor's backlash would shift the views of the sweeps against each other.

    Raises:
        ValueError: the passes do not divide the views, or leave fewer than two views a pass.
    """
    _require(views)
    if passes < 1 or views % passes or (passes > 1 and views // passes < 2):
        legal = [p for p in range(1, views // 2 + 1) if views % p == 0] or [1]
        some = ", ".join(map(str, legal[:12])) + (" ..." if len(legal) > 12 else "")
        raise ValueError(f"{views} views cannot be taken in {passes} equal passes of two or more; legal passes: {some}")
    index = (pass_order(passes)[:, None] + np.arange(0, views, passes)[None, :]).ravel()
    return fixed(views, start, span)[index]


def golden(views: int, start: float = 0.0, span: float = math.pi) -> NDArray[np.float64]:
    """View k stands at start + span * frac(k * GOLDEN) (Köhler 2004): well spread whenever the scan ends."""
    _require(views)
    return start + span * np.mod(np.arange(views, dtype=np.float64) * GOLDEN, 1.0)


def one_way(angles: NDArray[np.float64]) -> bool:
    """Whether views [view] follow each other in one direction: until the last one they see a sector."""
    steps = np.diff(angles)
    return bool((steps > 0).all() or (steps < 0).all())


def from_text(text: str, *, unknown: bool = False) -> NDArray[np.float64]:
    """Degrees, one a line, in the order of acquisition; # starts a comment, empty lines count for nothing.

    Args:
        unknown: lines may hold nan, as the log of a scan has it for darks and flats.

    Raises:
        ValueError: a line holds no finite number, or there is none; it names the line.
    """
    degrees = []
    for number, line in enumerate(text.splitlines(), start=1):
        word = line.split("#", 1)[0].strip()
        if not word:
            continue
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) or (unknown and word.lower() == "nan")):
            raise ValueError(f"line {number} holds {word!r}; expected one angle in degrees a line, such as 12.5")
        degrees.append(value)
    if not degrees:
        raise ValueError("it holds no angle; expected one angle in degrees a line")
    return np.deg2rad(np.array(degrees, dtype=np.float64))


@dataclass(frozen=True)
class Retake:
    """A view to repeat: its frame in the file (-1: it gave none), and its trigger within the views."""

    row: int
    trigger: int


def spread_retakes(views: Sequence[Retake], most: int) -> tuple[Retake, ...]:
    """At most so many of the views, evenly spread: gaps between them stay small."""
    return tuple(views[i] for i in spread(np.arange(len(views)), most))


def middle_of_exposure(views: Block) -> NDArray[np.float64]:
    """float64 [view] radians that the stage has turned past its trigger by the middle of each exposure.

    0 for a step scan. A standing stage at this angle shows the same as the view of a fly scan.
    """
    turned = np.zeros(views.n)
    first = 0
    for train in views.trains:
        passed = slice(first, first + train.n)
        turned[passed] = np.sign(views.angles[passed][-1] - views.angles[first]) * views.speed * views.exposure / 2
        first += train.n
    return turned


def return_triggers(views: Block, n: int) -> NDArray[np.int64]:
    """Triggers of `n` views, evenly spread in angle, in the order in which a stage passes them on its way back."""
    ahead = np.argsort(views.angles, kind="stable")
    chosen = spread(ahead, n)
    back = abs(views.angles[chosen[0]] - views.angles[-1]) > abs(views.angles[chosen[-1]] - views.angles[-1])
    return np.asarray(chosen[::-1] if back else chosen, np.int64)


def return_block(views: Block, n: int, *, stored: bool) -> Block:
    """The block that repeats some views on the way back; the stage stands during each exposure."""
    block = retake_block(views, return_triggers(views, n))
    return replace(block, kind=FrameKind.ALIGNMENT, stored=frozenset(range(block.n)) if stored else frozenset[int]())


def retake_block(views: Block, triggers: NDArray[np.int64]) -> Block:
    """The block that repeats these views, in their order; the stage stands during each exposure."""
    angles = views.angles[triggers] + middle_of_exposure(views)[triggers]
    period = views.exposure if views.trains else views.period
    return Block(FrameKind.PROJECTION, Mode.STEP, views.first_trigger + views.n, angles, views.exposure, period)
