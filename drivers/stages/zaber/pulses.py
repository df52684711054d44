"""The digital outputs of a Zaber device: one gives pulse trains by two triggers, others are switched by hand."""

from __future__ import annotations

from collections.abc import Callable

from drivers.base.errors import DeviceRefused
from drivers.base.protocols import TriggerTrain
from drivers.stages.zaber.axis import ZaberAxis
from drivers.stages.zaber.train import PulseSettings, has_started, remaining, set_up

ADVICE = (
    "Firmware without `schedule` needs toggle; firmware whose actions enable no triggers needs chained: false, and "
    "room for one step before the first pulse"
)


class ZaberPulses:
    """Sets up and takes away pulse trains.

    Raises (in all methods):
        DeviceRefused, DeviceError, DeviceTimeout: as `ZaberAxis`.
    """

    def __init__(self, axis: ZaberAxis, settings: PulseSettings, name: str) -> None:
        self.settings = settings
        self._axis, self._name = axis, name
        self._train: TriggerTrain | None = None
        self._touched = True

    def arm(self, train: TriggerTrain, counts: int, stand_at: Callable[[int], None]) -> None:
        """Set up the triggers for a train and enable the first one.

        Args:
            counts: where the stage stands.
            stand_at: turns the stage to another place.
        """
        setup = set_up(self.settings, train, self._axis.number, counts)
        self._train, self._touched = None, True
        try:
            for command in setup.commands:
                self._axis.ask(command)
            if setup.stand not in (None, counts):
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
        """Disable the triggers and put the output at rest, unless this was done already."""
        if self._touched:
            for command in (*self.settings.disable, self.settings.rest):
                self._axis.ask(command)
            self._train, self._touched = None, False

    def before_move(self, counts: int, target: int) -> None:
        """Keep a train correct before a move from `counts` against it, because distance counts both ways.

        A train under way ends. A train before its first pulse is set up anew, or ends if the stage had to move for it.
        """
        train = self._train
        if train is None or train.interval * (target - counts) >= 0 or not has_started(self.settings, self._shown()):
            return
        if self.settings.triggers.chained and remaining(self.settings, train, self._shown()) == train.n:
            self.arm(train, counts, _nowhere)
        else:
            self.disarm()

    def _shown(self) -> str:
        """The reply to `trigger show`, for at least this many triggers."""
        needed = max(self.settings.triggers.starter, self.settings.triggers.repeater)
        return self._axis.ask("trigger show", rf"(?:[de]|\d+)(?: (?:[de]|\d+)){{{needed - 1},}}").data


def _nowhere(counts: int) -> None:
    """Does nothing: a chained train may be set up at any place of the stage."""


class ZaberOutput:
    """A digital output of an open stage's device. Implements `drivers.base.protocols.DigitalOutput`."""

    def __init__(self, axis: ZaberAxis, number: int, name: str) -> None:
        self.name = name
        self._axis, self._number = axis, number

    def set(self, high: bool) -> None:
        self._axis.ask(f"io set do {self._number} {int(high)}")

    def get(self) -> bool:
        return self._axis.ask(f"io get do {self._number}", "[01]").data == "1"
