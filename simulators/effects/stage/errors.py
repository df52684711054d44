"""Errors of the stage: its encoder, backlash, wobble and runout of its axis; and a sample that slips on it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator

from simulators.effects.chain import Anomaly, AnomalyLabel, PoseEffect
from simulators.frame.mapping import NotNegative, Positive, Whole
from simulators.frame.shot import AngleAt, Pose, Shot, frame_rng

Wave = tuple[int, NotNegative, float]
"""Number of waves per turn, amplitude in the unit of the effect, and phase in degrees; 0 waves are a constant."""


def _once(waves: tuple[Wave, ...]) -> tuple[Wave, ...]:
    orders = [order for order, _, _ in waves]
    if len(set(orders)) < len(orders):
        raise ValueError(
            f"must be [waves a turn, amplitude, phase in degrees] for each number of waves once, got "
            f"{[list(wave) for wave in waves]}"
        )
    return waves


Waves = Annotated[tuple[Wave, ...], AfterValidator(_once)]


def series(angle: NDArray[np.float64], waves: Sequence[Wave]) -> NDArray[np.complex128]:
    """Sum of amplitude x exp(i (waves x angle + phase)) at `angle` in radians, any shape.

    A scalar effect takes the real part. A direction in the laboratory has the real part along u and minus the imaginary
    part along b. With one wave per turn this direction turns with the sample, with -1 against the sample.
    """
    total = np.zeros(np.shape(angle), dtype=np.complex128)
    for order, amplitude, phase in waves:
        total += amplitude * np.exp(1j * (order * angle + math.radians(phase)))
    return total


@dataclass(frozen=True)
class EncoderError(PoseEffect):
    """Angular positioning error: the sample is at the angle of the trigger plus the error.

    Attributes:
        harmonics: waves per turn, millidegrees, phase in degrees. An eccentric grating gives 1 wave, a gear gives one
            wave per tooth, and interpolation between the lines of an encoder gives one wave per line.
        random_mdeg: standard deviation of the random part, drawn for each frame.
    """

    harmonics: Waves = ()
    random_mdeg: NotNegative = 0.0

    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        error = series(pose.angle, self.harmonics).real + self.random_mdeg * frame_rng(self.name, shot).normal()
        return pose.turned_by(np.radians(1e-3 * error))


STILL = 1e-9  # radians; the stage counts as at rest below this
LOOK = 1e-3  # s; first step back in time, and precision of the end of the last move
HISTORY = 3600.0  # s before the frame; earlier moves are not searched for


@dataclass(frozen=True)
class Backlash(PoseEffect):
    """Lost motion of a gear (ISO 230-2:2014, reversal value). The gear is between the encoder, on the side of the
    motor, and the sample.

    While the stage turns forwards (angles grow), its angles are right. When it turns backwards, the other flanks of the
    teeth push, and the sample is `lost_motion_deg` ahead of the stage's angle. If the stage is at rest, its last move
    decides; if there was no move within an hour, forwards is assumed. The lost motion at the beginning of a move is not
    simulated, because the first projection of a scan comes after it.

    Attributes:
        lost_motion_deg: degrees by which the sample is ahead while the stage turns backwards.
    """

    lost_motion_deg: Positive

    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        if came_forwards(shot.angle_at, shot.time + float(times[0])):
            return pose
        return pose.turned_by(math.radians(self.lost_motion_deg))


def came_forwards(angle_at: AngleAt, time: float) -> bool:
    """True if the stage turns forwards at `time` (s), or did so in its last move before."""
    here = angle_at(time)

    def elsewhere(seconds: float) -> bool:
        return abs(angle_at(time - seconds) - here) > STILL

    seconds = LOOK
    while not elsewhere(seconds):
        if seconds > HISTORY:
            return True
        seconds *= 2
    still = seconds / 2 if seconds > LOOK else 0.0
    while seconds - still > LOOK:  # the step back may have skipped the last move
        middle = (still + seconds) / 2
        still, seconds = (still, middle) if elsewhere(middle) else (middle, seconds)
    return angle_at(time - seconds) < here


@dataclass(frozen=True)
class StageWobble(PoseEffect):
    """Tilt error motion of an axis of rotation (ISO 230-7:2015): a part that repeats every turn, and a random part.

    Attributes:
        harmonics: tilt of the axis: waves a turn, microradians, phase in degrees. 0 waves: a constant tilt, about u at
            phase 0, about b at -90. 1 wave: the tilt turns with the sample, equivalent to a tilted sample. Other
            numbers come from the bearing; a negative number turns against the sample.
        random_urad: standard deviation of the random part about u and about b, drawn for each frame.
    """

    harmonics: Waves = ()
    random_urad: NotNegative = 0.0

    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        wave = series(pose.angle, self.harmonics)
        tilt = np.stack([wave.real, -wave.imag], axis=1)
        tilt += self.random_urad * frame_rng(self.name, shot).normal(size=2)
        return pose.tilted_by(1e-6 * tilt)


@dataclass(frozen=True)
class Runout(PoseEffect):
    """Radial and axial error motion (ISO 230-7:2015), synchronous (harmonics) and asynchronous (drawn for each frame).

    Attributes:
        radial: motion of the axis across the beam and along the beam: waves per turn, micrometres, phase in degrees.
            1 wave is equivalent to a sample next to the axis, 0 waves to an axis at another place. Other numbers come
            from the bearing. A negative number turns against the sample.
        axial: the same for the vertical motion.
        radial_random_um: standard deviation of the random part across the beam, and along the beam.
        axial_random_um: standard deviation of the random vertical part.
    """

    radial: Waves = ()
    axial: Waves = ()
    radial_random_um: NotNegative = 0.0
    axial_random_um: NotNegative = 0.0

    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        radial, axial = series(pose.angle, self.radial), series(pose.angle, self.axial)
        shift = np.stack([radial.real, -radial.imag, axial.real], axis=1)
        shift += frame_rng(self.name, shot).normal(0.0, 1.0, 3) * (
            self.radial_random_um,
            self.radial_random_um,
            self.axial_random_um,
        )
        return pose.shifted_by(1e-3 * shift)


SEEN_PX = 0.01  # Smallest shift in pixels that is labelled; a shift along the beam is invisible


@dataclass(frozen=True)
class Jump(PoseEffect, Anomaly):
    """A jump: from projection `view` on, the sample is at another position on the stage: first rotated, then shifted.

    All projections from the jump on are labelled, because the jump changes them. In a scene, errors of the stage come
    before the jump, because they depend on the angle of the stage and not on that of the sample.

    Attributes:
        view: the first projection after the jump. shift_um: shift in micrometres along x, y (which turn with the stage)
            and z (along the axis). turn_deg: rotation in degrees about the axis, in the direction in which angles grow.
    """

    view: Whole
    shift_um: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: float = 0.0

    def __post_init__(self) -> None:
        if not (any(self.shift_um) or self.turn_deg):
            raise ValueError("at least one of shift_um and turn_deg must be other than 0")

    def pose(self, pose: Pose, times: NDArray[np.float64], shot: Shot) -> Pose:
        if shot.view < self.view:
            return pose
        return pose.turned_by(math.radians(self.turn_deg)).shifted_by(self._shift(pose.angle))

    def labels(self, shot: Shot) -> Sequence[AnomalyLabel]:
        """All rows of the columns that the sample can reach; its height is not known here."""
        if not (shot.beam and shot.sample and shot.view >= self.view):
            return []
        detector = shot.detector
        u, _, v = self._shift(np.array([shot.angle]))[0]
        if math.isinf(detector.sod) and not self.turn_deg and math.hypot(u, v) < SEEN_PX * detector.pitch:
            return []
        radius = shot.radius + 1e-3 * math.hypot(*self.shift_um[:2])
        if not math.isinf(detector.sod):
            radius /= max(1 - radius / detector.sod, 0.05)
        rows, cols = detector.shape
        first = max(0, math.ceil(detector.axis_col - radius / detector.pitch))
        last = min(cols - 1, math.floor(detector.axis_col + radius / detector.pitch))
        return [AnomalyLabel(self.name, (0, rows, first, last + 1))] if first <= last else []

    def _shift(self, angle: NDArray[np.float64]) -> NDArray[np.float64]:
        """mm along (u, b, v) at each angle, [row, 3]."""
        x, y, z = (1e-3 * um for um in self.shift_um)
        c, s = np.cos(angle), np.sin(angle)
        return np.stack([x * c + y * s, y * c - x * s, np.full_like(c, z)], axis=1)
