"""Tally: counts the frames of each block of a scan, and describes missing and extra frames in sentences."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from beamline.core.text import count, spans
from beamline.plan.plan import Block
from beamline.scan.ledger import Ledger
from drivers.base.frame import FrameKind
from drivers.base.protocols import CameraFrame

NAMED = 5  # largest number of projections that a sentence names
DOUBTFUL = 0.2  # steps; a larger possible error of an angle is reported
TRIES = 3  # number of exposures with the stage at a wrong angle, after which the projection counts as missing
OFF_TARGET_ADVICE = (
    f"A frame exposed at a wrong angle is kept as an invalid row, and its projection is taken again, up to {TRIES} "
    "times in total. Possible causes are another program or person that moves the stage, the manual knob of the stage, "
    "a servo that oscillates, or a controller that reports the end of a move too early"
)

ExposedFrame = tuple[CameraFrame, int, float, bool]
"""A frame, its trigger within the block (or EXTRA), the position of the stage in rad, and whether the position was the
planned angle."""


@dataclass
class BlockTally:
    """A block with its frames and missing triggers. It is filled while the block is taken.

    Attributes:
        is_retake: True if the block takes projections again. Missing frames in this block are then not a failure.
            frames: number of delivered frames, with and without a trigger. rows: for each trigger (counted within the
            block), the row and the time of its last frame. missing: triggers (counted within the block) whose frame
            did not come. lost, ignored: number of missing frames that were exposed but not delivered, and number that
            were not exposed, if known. extra: number of frames that no trigger exposed. unconfirmed: number of extra
            frames that were exposed while the stage braked. possible_shift, largest_residual: largest values of all
            passes, see `Ledger`. off_target: frames that were exposed while the stage was not at its planned angle: for
            each trigger, the row and the actual angle in rad.
    """

    block: Block
    is_retake: bool = False
    frames: int = 0
    rows: dict[int, tuple[int, float]] = field(default_factory=dict)
    missing: list[int] = field(default_factory=list)
    lost: int = 0
    ignored: int = 0
    extra: int = 0
    unconfirmed: int = 0
    possible_shift: int = 0
    largest_residual: float = 0.0
    off_target: dict[int, list[tuple[int, float]]] = field(default_factory=dict)

    def miss(self, triggers: Iterable[int]) -> None:
        """Record triggers without a frame. If a trigger has an earlier frame (perhaps without beam), it keeps this
        frame."""
        self.missing += [trigger for trigger in triggers if trigger not in self.rows]

    def enter(self, settled: Ledger, first: int) -> None:
        """Add a pass whose first trigger is `first`."""
        self.miss(first + i for i in settled.missing)
        self.lost += settled.lost
        self.ignored += settled.ignored
        self.extra += len(settled.extra)
        self.unconfirmed += settled.unconfirmed
        self.possible_shift = max(self.possible_shift, settled.possible_shift)
        self.largest_residual = max(self.largest_residual, settled.largest_residual)


def projection_tallies(done: Iterable[BlockTally]) -> list[BlockTally]:
    """The tallies of blocks of projections, without blocks that take projections again."""
    return [tally for tally in done if tally.block.kind is FrameKind.PROJECTION and not tally.is_retake]


def missing_views(done: Iterable[BlockTally]) -> tuple[int, ...]:
    """Triggers of the projections that gave no frame, in ascending order."""
    return tuple(sorted(i for tally in projection_tallies(done) for i in tally.missing))


def recover(done: Iterable[BlockTally], triggers: Collection[int]) -> int:
    """Record that these projections now have a frame and are no longer missing; returns how many of them were
    missing."""
    recovered = [(tally, i) for tally in projection_tallies(done) for i in {*tally.missing}.intersection(triggers)]
    for tally, trigger in recovered:
        tally.missing.remove(trigger)
    return len(recovered)


def off_target_sentence(tally: BlockTally) -> str:
    """A sentence on frames that were exposed while the stage was not at its planned angle, with the actual angles."""
    where = [
        f"projection {trigger} at {math.degrees(float(tally.block.angles[trigger])):.4g}°: "
        f"{math.degrees(exposures[-1][1]):.4f}°"
        for trigger, exposures in list(tally.off_target.items())[:NAMED]
    ]
    more = f", and {len(tally.off_target) - NAMED} more" if len(tally.off_target) > NAMED else ""
    n_exposures, n_projections = sum(map(len, tally.off_target.values())), len(tally.off_target)
    where_text = ", ".join(where)
    return (
        f"The stage was not at the planned angle in {n_exposures} exposures of {n_projections} projections "
        f"({where_text}{more}). {OFF_TARGET_ADVICE}."
    )


def discrepancies(done: Sequence[BlockTally]) -> str:
    """Sentences on missing, extra and doubtful frames of these blocks. Each sentence begins with a space."""
    return "".join(f" {text}" for tally in done if (text := _block_discrepancies(tally)))


def _block_discrepancies(tally: BlockTally) -> str:
    """Sentences on missing, extra and doubtful frames of a block. A projection that was taken again does not count as
    missing."""
    block, noun = tally.block, tally.block.kind.name.lower()
    text = ""
    if tally.missing and not tally.is_retake:
        n = len(tally.missing)
        angles = np.degrees(block.angles[tally.missing])
        angles_text = f" (from {angles[0]:.4g}° to {angles[-1]:.4g}°)" if n > 1 else f" (at {angles[0]:.4g}°)"
        angles_text = "" if np.isnan(angles).any() else angles_text
        text = f"{n} of {block.n} {noun}s {'is' if n == 1 else 'are'} missing: {spans(tally.missing)}{angles_text}."
        if tally.lost:
            text += (
                f" Exposed, but never delivered by the camera: {count(tally.lost, 'frame')}. `beamline check "
                "--connect` tests the link of the camera."
            )
        if astray := sum(trigger in tally.off_target for trigger in tally.missing):
            text += (
                f" For {astray} of the missing projections, the stage was off the planned angle in each of {TRIES} "
                "exposures (invalid rows)."
            )
        if tally.ignored:
            text += f" {count(tally.ignored, 'trigger')} gave no frame, because the camera was not ready at that time."
    if untriggered := tally.extra - tally.unconfirmed:
        text += f" {count(untriggered, 'frame')} came without a trigger. Such frames are kept as invalid rows."
    if tally.unconfirmed:
        text += (
            f" {count(tally.unconfirmed, 'frame')} came while the stage braked. Such frames are kept as invalid rows, "
            "because their angles are not certain: neither the trigger times nor the final position of the stage "
            "confirms the angles. Either the trigger line picks up noise, or the deceleration of the stage differs "
            "from its configured value."
        )
    if tally.possible_shift:
        text += (
            f" All angles of a pass may be wrong by up to {count(tally.possible_shift, 'step')}: the pass has missing "
            "or extra frames, and it is not known whether these frames are at the start or at the end of the pass."
        )
    if text and tally.largest_residual > DOUBTFUL:
        text += (
            f" A frame arrived {tally.largest_residual:.2f} periods away from its trigger, so the angle of this frame "
            "may be wrong by the same fraction of an angular step (the warnings of the check `timing` list the frames "
            "that came early or late)."
        )
    return text.strip()
