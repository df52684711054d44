"""Tally: counts the frames of each block of a scan, and describes missing and extra frames in sentences."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from beamline.core.text import spans
from beamline.plan.plan import Block
from beamline.scan.ledger import Ledger
from drivers.base.frame import FrameKind
from drivers.base.protocols import CameraFrame

NAMED = 5  # largest number of projections that a sentence names
DOUBTFUL = 0.2  # steps; a larger possible error of an angle is reported
TRIES = 3  # number of exposures with the stage at a wrong angle, after which the projection counts as missing
ASTRAY_ADVICE = (
    "A frame exposed at a wrong angle is kept as an invalid row, and its projection is taken again, up to "
    f"{TRIES} times in total. Possible causes are another program or person that moves the stage, its manual "
    "knob, a servo that oscillates, or a controller that reports the end of a move too early"
)

Exposed = tuple[CameraFrame, int, float, bool]
"""A frame, its trigger within the block (or EXTRA), the position of the stage in rad, and whether the position was the
planned angle."""


@dataclass
class BlockTally:
    """A block with its frames and missing triggers. It is filled while the block is taken.

    Attributes:
        again: True if the block takes projections again. Missing frames in this block are then not a failure. frames:
            number of delivered frames, with and without a trigger. rows: for each trigger (counted within the block),
            the row and the time of its last frame. missing: triggers (counted within the block) whose frame did not
            come. lost, ignored: number of missing frames that were exposed but not delivered, and number that were not
            exposed, if known. extra: number of frames that no trigger exposed. unconfirmed: number of extra frames that
            were exposed while the stage braked. shift, off: largest values of all passes, see `Ledger`. astray: frames
            that were exposed while the stage was not at its planned angle: for each trigger, the row and the actual
            angle in rad.
    """

    block: Block
    again: bool = False
    frames: int = 0
    rows: dict[int, tuple[int, float]] = field(default_factory=dict)
    missing: list[int] = field(default_factory=list)
    lost: int = 0
    ignored: int = 0
    extra: int = 0
    unconfirmed: int = 0
    shift: int = 0
    off: float = 0.0
    astray: dict[int, list[tuple[int, float]]] = field(default_factory=dict)

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
        self.shift = max(self.shift, settled.shift)
        self.off = max(self.off, settled.off)


def first_taken(done: Iterable[BlockTally]) -> list[BlockTally]:
    """The tallies of blocks of projections, without blocks that take projections again."""
    return [taken for taken in done if taken.block.kind is FrameKind.PROJECTION and not taken.again]


def missing_views(done: Iterable[BlockTally]) -> tuple[int, ...]:
    """Triggers of the projections that gave no frame, in ascending order."""
    return tuple(sorted(i for taken in first_taken(done) for i in taken.missing))


def recover(done: Iterable[BlockTally], triggers: Collection[int]) -> int:
    """Record that these projections now have a frame and are no longer missing; returns how many of them were
    missing."""
    came = [(taken, i) for taken in first_taken(done) for i in {*taken.missing}.intersection(triggers)]
    for taken, trigger in came:
        taken.missing.remove(trigger)
    return len(came)


def astray_views(taken: BlockTally) -> str:
    """A sentence on frames that were exposed while the stage was not at its planned angle, with the actual angles."""
    where = [
        f"projection {trigger} at {math.degrees(float(taken.block.angles[trigger])):.4g}°: "
        f"{math.degrees(places[-1][1]):.4f}°"
        for trigger, places in list(taken.astray.items())[:NAMED]
    ]
    more = f", and {len(taken.astray) - NAMED} more" if len(taken.astray) > NAMED else ""
    n_exposures, n_projections = sum(map(len, taken.astray.values())), len(taken.astray)
    where_text = ", ".join(where)
    return (
        f"The stage was not at the planned angle in {n_exposures} exposures of {n_projections} projections "
        f"({where_text}{more}). {ASTRAY_ADVICE}."
    )


def discrepancies(done: Sequence[BlockTally]) -> str:
    """Sentences on missing, extra and doubtful frames of these blocks. Each sentence begins with a space."""
    return "".join(f" {text}" for taken in done if (text := _of_block(taken)))


def _of_block(taken: BlockTally) -> str:
    """Sentences on missing, extra and doubtful frames of a block. A projection that was taken again does not count as
    missing."""
    block, noun = taken.block, taken.block.kind.name.lower()
    text = ""
    if taken.missing and not taken.again:
        n = len(taken.missing)
        angles = np.degrees(block.angles[taken.missing])
        at = "" if np.isnan(angles).any() else f" (from {angles[0]:.4g}° to {angles[-1]:.4g}°)"
        text = f"{n} of {block.n} {noun}s {'is' if n == 1 else 'are'} missing: {spans(taken.missing)}{at}."
        if taken.lost:
            text += (
                f" {taken.lost} were exposed but never delivered by the camera: `beamline check --connect` tests the "
                "link of the camera."
            )
        if astray := sum(trigger in taken.astray for trigger in taken.missing):
            text += (
                f" In {astray} of the missing projections, the stage was not at the planned angle in any of {TRIES} "
                "exposures (invalid rows)."
            )
        if taken.ignored:
            text += f" {taken.ignored} triggers gave no frame, because the camera was not ready and ignored them."
    if untriggered := taken.extra - taken.unconfirmed:
        text += f" {untriggered} frames came without a trigger and are kept as invalid rows."
    if taken.unconfirmed:
        text += (
            f" {taken.unconfirmed} frames came while the stage braked, and are kept as invalid rows. The angles of "
            "these frames are not certain: neither the trigger times nor the final position of the stage confirm "
            "the angles. Either the trigger line picks up noise, or the stage decelerates differently from its "
            "configured value."
        )
    if taken.shift:
        text += (
            f" All angles of a pass may be wrong by up to {taken.shift} steps: the pass has missing or extra frames, "
            "and it is not known whether these frames are at the start or at the end of the pass."
        )
    if text and taken.off > DOUBTFUL:
        text += (
            f" A frame arrived {taken.off:.2f} periods away from its trigger, so its angle may be wrong by the same "
            "fraction of an angular step (the warnings of the check `timing` list the frames that came early or "
            "late)."
        )
    return text.strip()
