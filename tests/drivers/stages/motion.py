"""Moves relative to where a stage stands, in whole counts, so that no angle is ever rounded twice."""

from __future__ import annotations

from drivers.protocols import Motion

FARTHEST = 1e9
"""rad; no stage goes further."""


def start_move_by(stage: Motion, angle: float, speed: float) -> None:
    """Begin a move by `angle` (rad, rounded once to whole counts) from the count where the stage stands, or is held by
    its servo: what a servo is beside that does not add up.

    n such moves make exactly n times these counts, however long the sum. Where an angle is no whole number of counts,
    its multiples are not n times them: for equally spaced views give `start_move` the multiples.

    Raises:
        DeviceRefused, DeviceError: as `start_move`.
    """
    if not abs(angle) < FARTHEST:
        stage.start_move(angle, speed)  # refuses in the stage's own words
        return
    status = stage.status()
    here = status.counts if status.held is None else status.held
    stage.start_move(stage.to_angle(here + stage.to_counts(angle)), speed)
