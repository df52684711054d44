"""ScanPlan: the planned scan as a value. The module also computes the angles of each scheme."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from beamline.core.text import are_a_count, with_points
from drivers.base.frame import FrameKind
from drivers.base.protocols import TriggerTrain
from recon.base.views import spread


class Mode(StrEnum):
    FLY = "fly"
    STEP = "step"
    STATIC = "static"  # darks and flats: the stage is at rest


class Place(StrEnum):
    NONE = "none"
    START = "start"
    END = "end"
    BOTH = "both"


@dataclass(frozen=True)
class FieldPlan:
    """Darks or flats: their number, when in the scan they are taken, and their exposure in s."""

    count: int
    at: Place
    exposure: float


@dataclass(frozen=True, eq=False)
class ScanPlan:
    """The requested scan.

    Attributes:
        angles: float64 [frame] radians, in the order of acquisition, with `frames_per_view` frames at each angle.
        mode: FLY (pulses from the moving stage) or STEP (move, settle, expose). exposure: exposure of a frame in s.
            period: time in s between the projections of a fly scan, which sets the speed; shortest time per projection
            of a step scan.
        settle: waiting time in s after each move of a step scan.
        darks, flats: plans of the darks and flats.
        scheme: how the angles were chosen ("fixed", "golden", ...). This value is only recorded.
        retake_share: largest fraction of the projections that are repeated after an alarm of the monitor; 0: none.
        stored: triggers of projections (followed by laterally offset projections) that are not taken: earlier files of
            the scan have them, or the scan has decided to omit them.
        choices: the choices (`passes.Choice`) that were made in earlier files of the same scan, one after each pass,
            oldest first. A continued scan is in the pass that the last choice started. choice_due: True if this pass
            has ended, and no choice was made yet.
        pass_views: number of projections in a pass of a step scan; 0: one pass with all projections. (The passes of a
            fly scan are its trains.)
        warm_up: time in s for which the scintillator is exposed each time the shutter opens, before frames with beam.
        end_references: kinds of darks and flats that must still be taken after the projections, for a scan in which
            everything else (except laterally offset projections) is stored. None: all planned darks and flats are
            taken, before and after the projections.
        offset_views: number of evenly spread angles at which one frame is taken with the sample shifted sideways to
            each of `offset_places` (mm).
        filter: position of the filter for all frames; None: leave it as it is.
        energy: energy of the monochromator for all frames in keV; None: leave it as it is.
        frames_per_view: number of frames at each angle of a step scan; the stage does not move between them.
    """

    angles: NDArray[np.float64]
    mode: Mode
    exposure: float
    period: float
    settle: float
    darks: FieldPlan
    flats: FieldPlan
    scheme: str
    retake_share: float = 0.0
    stored: frozenset[int] = frozenset()
    choices: tuple[str, ...] = ()
    choice_due: bool = False
    pass_views: int = 0
    end_references: frozenset[FrameKind] | None = None
    warm_up: float = 0.0
    offset_views: int = 0
    offset_places: tuple[float, ...] = ()
    filter: str | None = None
    energy: float | None = None
    frames_per_view: int = 1

    @property
    def n_views(self) -> int:
        """Number of projections, each of `frames_per_view` frames."""
        return int(self.angles.size) // self.frames_per_view

    @property
    def retakes(self) -> int:
        """Largest number of repeated projections."""
        return max(1, int(self.retake_share * self.angles.size)) if self.retake_share > 0 else 0


@dataclass(frozen=True, eq=False)
class Block:
    """A sequence of frames that are taken in the same way. Blocks follow one another in the file.

    Attributes:
        kind: what the frames show.
        mode: how they are triggered.
        first_trigger: trigger of the first frame of the block, counted in the whole plan.
        angles: float64 [frame], angles of the rows in radians, at whole counts. For darks and flats they are NaN until
            the acquisition fills in the angle of the stage.
        exposure, period: times in s. trains: for FLY, one pulse train per pass (interlaced plans have several).
        speed: speed of the stage in rad/s during the pulses (FLY).
        taxi: run-up in radians before the first and after the last pulse (FLY).
        stored: frames of the block (counted within the block) that are not taken.
        aside: sideways shift of the sample in mm, as in `Frame.aside`.
    """

    kind: FrameKind
    mode: Mode
    first_trigger: int
    angles: NDArray[np.float64]
    exposure: float
    period: float
    trains: tuple[TriggerTrain, ...] = ()
    speed: float = 0.0
    taxi: float = 0.0
    stored: frozenset[int] = frozenset()
    aside: float = 0.0

    @property
    def n(self) -> int:
        return int(self.angles.size)

    @property
    def n_to_take(self) -> int:
        """Number of frames that must still be taken."""
        return self.n - len(self.stored)


@dataclass(frozen=True)
class Timeline:
    """A plan computed for one stage and one camera. The scan may start only if `violations` is empty.

    Attributes:
        blocks: in the order of acquisition.
        duration: time in s, including run-up, settling, moves, warm-up, darks and flats; without projections that are
            taken again.
        frame_bytes: size of the uint16 pixels of one frame.
        total_bytes: size of the whole file, pixels and previews; without projections that are taken again.
        step_counts: whole counts between neighbouring fly triggers (0 for a step scan).
        step: the angular step in radians.
        blur_px: distance in pixels by which a point at the detector's edge moves during an exposure. skew_px: distance
            in pixels by which this point moves between the exposures of the first and the last row (rolling shutter).
        violations: one sentence for each exceeded limit, with values and what to do.
        remarks: facts for the operator that do not exceed a limit.
        plan: the plan from which the timeline is computed.
        retake_seconds: time for the largest number of projections that may be taken again. parts: the parts of
            `duration` in s: each kind of frames (with the moves before and between them), the warm_up of the
            scintillator, and the return of the stage.
    """

    blocks: tuple[Block, ...]
    duration: float
    frame_bytes: int
    total_bytes: int
    step_counts: int
    step: float
    blur_px: float
    skew_px: float
    violations: tuple[str, ...]
    remarks: tuple[str, ...]
    plan: ScanPlan
    retake_seconds: float = 0.0
    parts: Mapping[str, float] = field(default_factory=dict)

    @property
    def n_frames(self) -> int:
        return sum(block.n_to_take for block in self.blocks)

    @property
    def first_rows(self) -> list[int]:
        """File row of the first frame of each block."""
        return [0, *accumulate(block.n_to_take for block in self.blocks[:-1])]

    @property
    def in_beam(self) -> float:
        """Time in s for which the sample is in the beam, from the first move for projections to the last frame of a
        projection."""
        kinds = [block.kind for block in self.blocks if block.n_to_take and block.kind is not FrameKind.DARK]
        warm = "warm_up" if kinds[:1] == [FrameKind.PROJECTION] else ""
        return sum(self.parts.get(part, 0.0) for part in ("projection", "offset_view", warm))

    @property
    def views(self) -> Block:
        """The block of projections, which every timeline has."""
        return next(block for block in self.blocks if block.kind is FrameKind.PROJECTION)


def summed(*parts: tuple[str, float]) -> dict[str, float]:
    """Seconds by part. Parts of the same name are added up, and parts of 0 s are left out."""
    sums = dict[str, float]()
    for part, seconds in parts:
        if seconds:
            sums[part] = sums.get(part, 0.0) + seconds
    return sums


GOLDEN = (math.sqrt(5) - 1) / 2
"""The golden section; modulo one, its multiples stay spread at every length (three-gap theorem, Sós 1957)."""


def _require(views: int) -> None:
    if views < 1:
        raise ValueError(f"a plan needs at least 1 projection, got {views}")


def fixed(views: int, start: float = 0.0, span: float = math.pi) -> NDArray[np.float64]:
    """Equal steps of span / views from `start`. The end is excluded, because it shows the same as the start (or its
    mirror image).

    A negative span turns the other way.
    """
    _require(views)
    return start + np.arange(views, dtype=np.float64) * (span / views)


def sector(views: int, first: float, last: float) -> NDArray[np.float64]:
    """Equal steps from `first` to `last`, both included: a limited-angle scan. A single projection is at `first`."""
    _require(views)
    return np.linspace(first, last, views)


def random(views: int, start: float = 0.0, span: float = math.pi, *, rng: np.random.Generator) -> NDArray[np.float64]:
    """Uniformly random angles in [start, start + span), sorted, so that the stage passes the range only once."""
    _require(views)
    return start + span * np.sort(rng.random(views))


def pass_order(passes: int) -> NDArray[np.intp]:
    """The order in which the gaps of the first pass are filled: a permutation of 0 ... passes - 1.

    The order is the bit reversal (Mohan et al. 2015, TIMBIR) for the next power of two, without values that are
    `passes` or more. Therefore each pass is near the middle of the largest remaining gap, for any number of passes.
    """
    _require(passes)
    bits = (passes - 1).bit_length()
    values = np.arange(1 << bits)
    reversed_bits = sum((((values >> bit) & 1) << (bits - 1 - bit) for bit in range(bits)), np.zeros_like(values))
    return reversed_bits[reversed_bits < passes].astype(np.intp)


def interlaced(views: int, passes: int, start: float = 0.0, span: float = math.pi) -> NDArray[np.float64]:
    """The `fixed` angles in `passes` rotations over the range. All rotations have the same direction, and each takes
    every passes-th projection.

    The reason for the same direction: the backlash of a motor would otherwise shift the projections of different
    rotations against each other.

    Raises:
        ValueError: the projections cannot be divided into these passes, or a pass would have fewer than two
            projections.
    """
    _require(views)
    if passes < 1 or views % passes or (passes > 1 and views // passes < 2):
        legal = [p for p in range(1, views // 2 + 1) if views % p == 0] or [1]
        listed = ", ".join(map(str, legal[:12])) + (" ..." if len(legal) > 12 else "")
        raise ValueError(
            f"{views} projections cannot be divided into {passes} equal passes of two or more projections; "
            f"possible numbers of passes: {listed}"
        )
    index = (pass_order(passes)[:, None] + np.arange(0, views, passes)[None, :]).ravel()
    return fixed(views, start, span)[index]


def golden(views: int, start: float = 0.0, span: float = math.pi) -> NDArray[np.float64]:
    """Projection k is at start + span * frac(k * GOLDEN) (Köhler 2004). So the angles are well spread whenever the scan
    ends."""
    _require(views)
    return start + span * np.mod(np.arange(views, dtype=np.float64) * GOLDEN, 1.0)


def one_way(angles: NDArray[np.float64]) -> bool:
    """True if the angles [view] follow each other in one direction, so that until the last projection they cover only a
    sector."""
    steps = np.diff(angles)
    return bool((steps > 0).all() or (steps < 0).all())


def from_text(text: str, *, unknown: bool = False) -> NDArray[np.float64]:
    """Parse degrees, one per line, in the order of acquisition; # starts a comment, empty lines are ignored, decimals
    follow a point or a comma.

    Args:
        unknown: True if lines may be nan, as in the log of a scan for darks and flats.

    Raises:
        ValueError: a line is not a finite number (the message names it), or the file has no line.
    """
    words = [line.split("#", 1)[0].strip() for line in text.splitlines()]
    columns = [*zip(*(word.split(",") for word in words if "," in word), strict=False)]
    if any(map(are_a_count, columns)) and all(len({*column}) > 1 for column in columns):
        last_with_comma = [word for word in words if "," in word][-1]
        raise ValueError(
            f"the file of angles contains {last_with_comma!r}, which may be the number of a projection and its "
            "angle, or an angle with a decimal comma; expected one angle per line"
        )
    degrees = []
    for number, (word, plain) in enumerate(zip(words, with_points(words), strict=True), start=1):
        if not word:
            continue
        try:
            value = float(plain)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) or (unknown and word.lower() == "nan")):
            raise ValueError(f"line {number} contains {word!r}; expected one angle in degrees per line, such as 12.5")
        degrees.append(value)
    if not degrees:
        raise ValueError("the file contains no angle; expected one angle in degrees per line")
    return np.deg2rad(np.array(degrees, dtype=np.float64))


@dataclass(frozen=True)
class Retake:
    """A projection to take again: its frame in the file (-1 if it has none), and its trigger among the projections."""

    row: int
    trigger: int


def spread_retakes(views: Sequence[Retake], most: int) -> tuple[Retake, ...]:
    """A limited number of the projections, evenly spread, so that gaps between them stay small."""
    return tuple(views[i] for i in spread(np.arange(len(views)), most))


def middle_of_exposure(views: Block) -> NDArray[np.float64]:
    """float64 [view], angle in radians by which the stage turns from the trigger to the middle of each exposure.

    It is 0 for a step scan. A stage at rest at the angle of the trigger plus this angle shows the same as the
    projection of the fly scan.
    """
    turned = np.zeros(views.n)
    first = 0
    for train in views.trains:
        passed = slice(first, first + train.n)
        turned[passed] = np.sign(views.angles[passed][-1] - views.angles[first]) * views.speed * views.exposure / 2
        first += train.n
    return turned


def offset_block(views: Block, n: int, aside: float) -> Block:
    """The block of laterally offset projections, with the sample shifted by `aside`, at `n` evenly spread angles. The
    stage is at rest during each exposure."""
    triggers = np.argsort(views.angles, kind="stable")[np.arange(n) * views.n // n]
    return replace(retake_block(views, triggers), kind=FrameKind.OFFSET_VIEW, aside=aside)


def retake_block(views: Block, triggers: NDArray[np.int64]) -> Block:
    """The block that takes these projections again, in this order. The stage is at rest during each exposure."""
    angles = views.angles[triggers] + middle_of_exposure(views)[triggers]
    period = views.exposure if views.trains else views.period
    return Block(FrameKind.PROJECTION, Mode.STEP, views.first_trigger + views.n, angles, views.exposure, period)
