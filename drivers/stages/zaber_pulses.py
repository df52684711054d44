"""The digital outputs of a Zaber device: one gives pulse trains by two triggers, others are switched by hand."""

from __future__ import annotations

from collections.abc import Callable

from drivers.errors import DeviceError, DeviceRefused
from drivers.protocols import TriggerTrain
from drivers.stages.zaber_axis import ZaberAxis
from drivers.stages.zaber_train import PulseSettings, remaining, set_up

ADVICE = (
    "Firmware without `schedule` needs toggle; firmware whose actions enable no triggers needs chained: false, and "
    "room for one step before the first pulse"
)


class ZaberPulses:
    """Sets up, takes away and counts pulse trains.

    Raises (in all methods):
        DeviceRefused, DeviceError, DeviceTimeout: as `ZaberAxis`.
    """

    def __init__(self, axis: ZaberAxis, settings: PulseSettings, name: str) -> None:
        self.settings = settings
        self._axis, self._name = axis, name
        self._train: TriggerTrain | None = None
        self._touched = True

    def arm(self, train: TriggerTrain, stand_at: Callable[[int], None]) -> None:
        """Set up the triggers for a train and enable the first; `stand_at(counts)` brings the stage to a place."""
        setup = set_up(self.settings, train, self._axis.number)
        self._train, self._touched = None, True
        try:
            for command in setup.commands:
                self._axis.ask(command)
            if setup.stand is not None:
                stand_at(setup.stand)
            self._axis.ask(setup.enable)
        except DeviceRefused as problem:
            raise DeviceRefused(
                self._name,
                f"the triggers cannot be set up: {problem.problem}",
                request=problem.request,
                reply=problem.reply,
                advice=ADVICE,
                state="This train is not armed",
            ) from problem
        self._train = train

    def disarm(self) -> None:
        """Disable the triggers and put the output at rest, where that was not done yet."""
        if self._touched:
            for command in (*self.settings.disable, self.settings.rest):
                self._axis.ask(command)
            self._train, self._touched = None, False

    def remaining(self) -> int:
        """Pulses still to come."""
        if self._train is None:
            return 0
        reply = self._axis.ask("trigger show")
        try:
            return remaining(self.settings, self._train, reply.data)
        except ValueError as problem:
            raise DeviceError(
                self._name,
                str(problem),
                reply=reply.raw,
                expected="a state for each trigger",
                state="The train stays armed",
            ) from problem

    def end_if_against(self, way: int) -> None:
        """Take a train away that has begun, if a move by `way` counts goes against it."""
        if self._train is not None and self._train.interval * way < 0 and self.remaining() < self._train.n:
            self.disarm()


class ZaberOutput:
    """A digital output of a device whose stage is open. Implements `drivers.shutter.DigitalOutput`."""

    def __init__(self, axis: ZaberAxis, number: int, name: str) -> None:
        self.name = name
        self._axis, self._number = axis, number

    def set(self, high: bool) -> None:
        self._axis.ask(f"io set do {self._number} {int(high)}")

    def get(self) -> bool:
        return self._axis.ask(f"io get do {self._number}", "[01]").data == "1"
