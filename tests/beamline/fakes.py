"""A fake instrument on a virtual clock that writes its state into its pixels, so that frames prove the sequence."""

import math
from collections.abc import Callable, Iterable, Mapping, Set
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.instrument.connect import ConnectedDevices
from beamline.plan.plan import FieldPlan, Mode, Place, ScanPlan, Timeline
from beamline.plan.timeline import work_out
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.frame import Frame, FrameKind
from drivers.base.protocols import (
    CameraFrame,
    CameraSettings,
    CameraTiming,
    Devices,
    DigitalOutput,
    StageLimits,
    TriggerSource,
    TriggerTrain,
)
from simulators.devices.clock import VirtualClock
from simulators.devices.motion import TrapezoidMove

COUNTS_PER_TURN = 36000
SHAPE = (8, 12)
COUNT = 2 * math.pi / COUNTS_PER_TURN
LEVEL = {False: 200, True: 20000}  # counts without and with beam
HOME = 100  # position of the stage at the start, in counts


@dataclass(frozen=True)
class Exposed:
    time: float
    framestamp: int
    number: int
    state: tuple[int, ...]


@dataclass
class Faults:
    """Faults by trigger number; all software and hardware triggers of the camera are counted from 0."""

    lost: Set[int] = frozenset()
    ignored: Set[int] = frozenset()
    extra_after: Set[int] = frozenset()  # hardware triggers that are followed by a spurious one half a period later
    # for a hardware trigger: an exposure caused by noise, in periods before it
    noise: dict[int, float] = field(default_factory=dict)
    errors: dict[int, int] = field(default_factory=dict)  # for a frame number: how often reading it raises DeviceError
    repeats: Set[int] = frozenset()  # frames that are identical to the previous one
    stuck_shutter: bool = False
    stall_at: int | None = None  # count


class FakeInstrument:
    """Stage, camera, shutter and sample mover in one object; acquisition uses its `devices`.

    Pixels contain the intensity and noise. Row 0 also encodes the stage position at the trigger in counts, whether the
    shutter was open and the sample in the beam, and the number of the trigger; see `decode`. `log` contains the
    commands to the devices. When a frame is taken, `on_frame(number)` is called, and the function in `at` for its
    number.
    """

    def __init__(
        self,
        faults: Faults | None = None,
        on_frame: Callable[[int], None] = lambda number: None,
        at: Mapping[int, Callable[[], object]] | None = None,
    ) -> None:
        self.faults, self.on_frame, self.at = faults or Faults(), on_frame, at or {}
        self.clock = VirtualClock()
        self.period = 1.0
        self.log: list[str] = []
        self.is_open, self.is_in = False, True
        self.stage, self.camera = Stage(self), Camera(self)
        self.devices = Devices(self.stage, self.camera, Shutter(self), Sample(self))

    def connected(self) -> ConnectedDevices:
        return ConnectedDevices(self.devices, self.clock, None, lambda: self.log.append("close"))

    def timeline(
        self, n: int = 12, mode: Mode = Mode.FLY, passes: int = 1, at: Place = Place.START, speed: float = 30.0
    ) -> Timeline:
        """A timeline of `n` projections over 180° at `speed` (degrees/s, one pass) with 3 darks and 2 flats."""
        return self.worked_out(self.plan(n, mode, passes, at, speed))

    def worked_out(self, plan: ScanPlan) -> Timeline:
        timeline = work_out(plan, self.stage.limits, self.stage.to_counts, self.camera.timing)
        assert timeline.violations == ()
        return timeline

    def plan(
        self, n: int = 12, mode: Mode = Mode.FLY, passes: int = 1, at: Place = Place.START, speed: float = 30.0
    ) -> ScanPlan:
        self.period = 180 * passes / n / speed
        angles = np.linspace(0, np.pi, n, endpoint=False)
        angles = np.concatenate([angles[i::passes] for i in range(passes)])
        return ScanPlan(angles, mode, 0.02, self.period, 0.05, FieldPlan(3, at, 0.02), FieldPlan(2, at, 0.03), "fixed")


class Stage:
    name = "stage"
    limits = StageLimits(
        COUNTS_PER_TURN, math.radians(60), math.radians(200), math.radians(-90), math.radians(270), True
    )

    def __init__(self, instrument: FakeInstrument) -> None:
        self.instrument = instrument
        self.move = TrapezoidMove(instrument.clock.now(), HOME, HOME, ())
        self.target = HOME
        self.train: TriggerTrain | None = None
        self.pulses: list[tuple[float, int]] = []

    def to_counts(self, angle: float) -> int:
        return round(angle / COUNT)

    def to_angle(self, counts: int) -> float:
        return counts * COUNT

    def count(self, time: float) -> float:
        return self.move.position(time)

    def position(self) -> float:
        return self.count(self.instrument.clock.now()) * COUNT

    def start_move(self, angle: float, speed: float) -> None:
        assert not self.moving()
        now = self.instrument.clock.now()
        self.instrument.log.append(f"move {self.to_counts(angle)}")
        self.target = self.to_counts(angle)
        move = TrapezoidMove.between(
            self.count(now), self.target, speed / COUNT, self.limits.acceleration / COUNT, begin=now
        )
        stall = self.instrument.faults.stall_at
        if stall is not None and min(move.start, move.target) < stall < max(move.start, move.target):
            move = move.halted(stall)
        self.move = move
        if self.train is not None:
            points = range(self.train.start, self.train.end + self.train.interval, self.train.interval)
            low, high = sorted((move.start, move.target))
            self.pulses = [(move.time_at(p), p) for p in points if low <= p <= high]
            self.train = None

    def moving(self) -> bool:
        return self.instrument.clock.now() < self.move.end

    def start_home(self) -> None:
        raise DeviceRefused(self.name, "it has no reference")

    def wait(self, timeout: float) -> float:
        now = self.instrument.clock.now()
        self.instrument.clock.sleep(min(timeout, self.move.end - now))
        if self.moving():
            raise DeviceTimeout(self.name, "still moving")
        if self.count(self.instrument.clock.now()) != self.target:
            raise DeviceError(self.name, "stopped short")
        return self.position()

    def arm(self, train: TriggerTrain) -> None:
        assert not self.moving()
        assert (train.start - self.count(self.instrument.clock.now())) * train.interval > 0
        self.instrument.log.append("arm stage")
        self.train = train

    def disarm(self) -> None:
        assert not self.moving()
        self.train = None
        self.pulses = []

    def stop(self) -> None:
        self.instrument.log.append("stop stage")
        self._cut(self.move.braked(self.instrument.clock.now(), self.limits.acceleration / COUNT))

    def abort(self) -> None:
        self.instrument.log.append("abort stage")
        self._cut(self.move.halted(self.count(self.instrument.clock.now())))

    def _cut(self, move: TrapezoidMove) -> None:
        if self.moving():
            self.move = move
            low, high = sorted((move.start, move.target))
            self.pulses = [(move.time_at(p), p) for _, p in self.pulses if low <= p <= high]

    def digital_output(self, number: int) -> DigitalOutput:
        raise DeviceRefused(self.name, "it has no outputs")

    def describe(self) -> dict[str, str | int | float]:
        return {"model": "fake stage"}

    def close(self) -> None:
        self.instrument.log.append("close stage")


class Camera:
    name = "camera"

    def __init__(self, instrument: FakeInstrument) -> None:
        self.instrument = instrument
        self.rng = np.random.default_rng(1)
        self.last = np.zeros(SHAPE, np.uint16)
        self.settings = CameraSettings(0.02, TriggerSource.INTERNAL)
        self.armed = False
        self.ring: list[Exposed] = []
        self.framestamp = self.number = 0
        self.seen = self.spurious = 0.0

    @property
    def timing(self) -> CameraTiming:
        return CameraTiming(SHAPE, self.settings.exposure + 0.002, 0.001, 0.0, 16)

    def configure(self, settings: CameraSettings) -> CameraSettings:
        assert not self.armed
        self.settings = settings
        return settings

    def arm(self, n_frames: int) -> None:
        assert not self.armed
        assert n_frames >= 1
        self.instrument.log.append(f"arm camera {n_frames}")
        self.armed, self.framestamp, self.ring, self.seen = True, 0, [], self.instrument.clock.now()

    def software_trigger(self) -> None:
        assert self.armed
        assert self.settings.trigger is TriggerSource.SOFTWARE
        now = self.instrument.clock.now()
        self._trigger(now, round(self.instrument.stage.count(now)))

    def _trigger(self, time: float, count: int) -> None:
        number, self.number = self.number, self.number + 1
        if number in self.instrument.faults.ignored:
            return
        self._expose(time, number, count)

    def _expose(self, time: float, number: int, count: int) -> None:
        if number not in self.instrument.faults.lost:
            state = (count + 32768, self.instrument.is_open, self.instrument.is_in, max(number, 0))
            self.ring.append(Exposed(time, self.framestamp, number, state))
        self.framestamp += 1

    def _catch_up(self, now: float) -> None:
        assert self.settings.trigger in (TriggerSource.SOFTWARE, TriggerSource.EXTERNAL)
        if self.settings.trigger is not TriggerSource.EXTERNAL:
            return
        for time, count in self.instrument.stage.pulses:
            if self.seen < time <= now:
                number = self.number
                self.seen = time
                if number in self.instrument.faults.noise:
                    early = self.instrument.faults.noise[number] * self.instrument.period
                    self._expose(time - early, -1, round(self.instrument.stage.count(time - early)))
                self._trigger(time, count)
                if number in self.instrument.faults.extra_after:
                    self._expose(time + self.instrument.period / 2, -1, count)

    def next_frame(self, timeout: float) -> CameraFrame:
        assert self.armed
        clock = self.instrument.clock
        deadline = clock.now() + timeout
        delay = self.settings.exposure + 0.001
        while True:
            now = clock.now()
            self._catch_up(now)
            if self.ring and self.ring[0].time + delay <= now:
                return self._take(self.ring[0])
            if now >= deadline:
                raise DeviceTimeout(self.name, f"no frame within {timeout} s")
            due = [time for time, _ in self.instrument.stage.pulses if time > now]
            due += [frame.time + delay for frame in self.ring[:1]]
            # It checks every 10 ms; checks that would find nothing are skipped.
            looks = math.ceil((min([deadline, *due]) - now) / 0.01)
            clock.sleep(min(deadline - now, 0.01 * max(1, looks)))

    def _take(self, frame: Exposed) -> CameraFrame:
        if self.instrument.faults.errors.get(frame.number, 0) > 0:
            self.instrument.faults.errors[frame.number] -= 1
            raise DeviceError(self.name, "ring overrun")
        self.ring.pop(0)
        count, is_open, is_in, number = frame.state
        counts = (LEVEL[bool(is_open)] + self.rng.integers(0, 20, SHAPE)).astype(np.uint16)
        row = [*digits(count), is_open, is_in, *digits(number)]
        counts[0, : len(row)] = LEVEL[bool(is_open)] + np.array(row)
        if frame.number in self.instrument.faults.repeats:
            counts = self.last.copy()
        self.last = counts
        self.instrument.on_frame(frame.number)
        self.instrument.at.get(frame.number, lambda: None)()
        return CameraFrame(counts, frame.framestamp, frame.time)

    def disarm(self) -> None:
        self.armed = False
        self.ring = []

    def describe(self) -> dict[str, str | int | float]:
        return {"model": "fake camera"}

    def close(self) -> None:
        self.instrument.log.append("close camera")


class Shutter:
    name = "shutter"
    by_hand = False

    def __init__(self, instrument: FakeInstrument) -> None:
        self.instrument = instrument

    def open(self) -> None:
        self.instrument.is_open = not self.instrument.faults.stuck_shutter

    def close(self) -> None:
        self.instrument.log.append("close shutter")
        self.instrument.is_open = False

    def is_open(self) -> bool:
        return self.instrument.is_open


class Sample:
    name = "sample"

    def __init__(self, instrument: FakeInstrument) -> None:
        self.instrument = instrument

    def out(self) -> None:
        self.instrument.is_in = False

    def back(self, aside: float = 0.0) -> None:
        self.instrument.is_in = True


def digits(value: int) -> list[int]:
    """Three digits in base 64, so that no pixel deviates by more than 63 counts."""
    return [value // 4096 % 64, value // 64 % 64, value % 64]


def decode(counts: NDArray[np.uint16]) -> tuple[int, bool, bool, int]:
    """The encoded state of the instrument: stage count, shutter open, sample in the beam, trigger number."""
    level = LEVEL[bool(counts[-1].mean() > 1000)]
    row = [int(v) - level for v in counts[0, :8]]
    count = row[0] * 4096 + row[1] * 64 + row[2]
    return count - 32768, bool(row[3]), bool(row[4]), row[5] * 4096 + row[6] * 64 + row[7]


def assert_true(frames: Iterable[Frame], within: float = COUNT) -> None:
    """Assert that each frame has the kind and (within `within` radians) the angle that the camera wrote into its
    pixels."""
    for frame in frames:
        count, is_open, is_in, _ = decode(frame.counts)
        assert (is_open, is_in) == (frame.kind is not FrameKind.DARK, frame.kind is not FrameKind.FLAT)
        if frame.kind is not FrameKind.INVALID:
            assert frame.angle == pytest.approx(count * COUNT, abs=within)
