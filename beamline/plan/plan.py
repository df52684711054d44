"""ScanPlan: the planned scan as a value; its timeline gives times, speeds, blur and bytes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from drivers.base.frame import FrameKind
from drivers.base.protocols import TriggerTrain


class Mode(StrEnum):
    FLY = "fly"
    STEP = "step"
    STATIC = "static"  # darks and flats: the stage stands


class Place(StrEnum):
    NONE = "none"
    START = "start"
    END = "end"
    BOTH = "both"


@dataclass(frozen=True)
class FieldPlan:
    """Darks or flats: how many, where in the scan, and their own exposure in s."""

    count: int
    at: Place
    exposure: float


@dataclass(frozen=True, eq=False)
class ScanPlan:
    """The requested scan.

    Attributes:
        angles: float64 [frame] radians, in the order of acquisition; `frames_per_view` at each.
        mode: FLY (pulses from the moving stage) or STEP (move, settle, expose).
        exposure: s per view.
        period: s between views of a fly scan (sets the speed); for a step scan the least time per view.
        settle: s to wait after each move of a step scan.
        darks, flats: reference frames.
        scheme: how the angles were chosen ("fixed", "golden", ...), for the record.
        retake_share: largest share of the views that are repeated after an alarm of the monitor; 0: none.
        stored: views that need not be taken: earlier files of the same scan have them.
        warm_up: s of light on the scintillator before frames with light, each time the shutter opens.
        end_references: kinds of references that are still to be taken after the views, where all else is stored. None:
            all that are planned, before and after the views.
        return_views: views that are taken a second time on the way back, evenly spread; alignment frames.
        filter: the place of the filter for all frames; None: as it stands.
        energy: keV of the monochromator for all frames; None: as it stands.
        frames_per_view: of a step scan; the stage neither moves nor settles between them.
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
    end_references: frozenset[FrameKind] | None = None
    warm_up: float = 0.0
    return_views: int = 0
    filter: str | None = None
    energy: float | None = None
    frames_per_view: int = 1

    @property
    def n_views(self) -> int:
        """Views, each of `frames_per_view` frames."""
        return int(self.angles.size) // self.frames_per_view

    @property
    def retakes(self) -> int:
        """Largest number of repeated views."""
        return max(1, int(self.retake_share * self.angles.size)) if self.retake_share > 0 else 0


@dataclass(frozen=True, eq=False)
class Block:
    """A run of frames taken in one way; blocks follow one another in the file, row after row.

    Attributes:
        kind: what the frames show.
        mode: how they are triggered.
        first_trigger: of the block's first frame, within the whole plan.
        angles: float64 [frame] radians at whole counts, the angles of the rows. NaN in darks and flats until
            acquisition fills in where the stage stands.
        exposure, period: s.
        trains: for FLY, one pulse train a pass (interlaced plans need several); their n add up to the block's.
        speed: rad/s during the pulses (FLY).
        taxi: radians of run-up before the first and after the last pulse (FLY).
        stored: frames of the block, counted within it, that are not taken.
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

    @property
    def n(self) -> int:
        return int(self.angles.size)

    @property
    def left(self) -> int:
        """Number of frames to take."""
        return self.n - len(self.stored)


@dataclass(frozen=True)
class Timeline:
    """A plan computed for one stage and one camera. The scan may start exactly if `violations` is empty.

    Attributes:
        blocks: in the order of acquisition.
        duration: s, with taxi, settling, moves, warm-up and reference frames; without views that are taken again.
        frame_bytes: of one frame's uint16 pixels.
        total_bytes: of the whole file, pixels and previews; without views that are taken again.
        step_counts: whole counts between neighbouring fly triggers (0 for a step scan).
        step: the same in radians.
        blur_px: how far a point at the detector's edge moves during an exposure, in pixels.
        skew_px: how far it moves between the first and the last row's exposure (rolling shutter), in pixels.
        violations: every limit that is broken, each one sentence with values and what to do.
        remarks: facts for the operator that break no limit.
        retake_seconds: for the most views that may be taken again.
        warm_up, filter, energy: as of the plan.
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
    retake_seconds: float = 0.0
    warm_up: float = 0.0
    filter: str | None = None
    energy: float | None = None

    @property
    def n_frames(self) -> int:
        return sum(block.left for block in self.blocks)

    @property
    def first_rows(self) -> list[int]:
        """File row of the first frame of each block."""
        return [0, *accumulate(block.left for block in self.blocks[:-1])]

    @property
    def views(self) -> Block:
        """The block of projections, which every timeline has."""
        return next(block for block in self.blocks if block.kind is FrameKind.PROJECTION)
