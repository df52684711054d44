"""Flagged frames: which frames of a scan have flags, the effect of the flags on the scan, and which projections are
taken again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from beamline.core.events import FrameFlagged, Sink, Warned
from beamline.core.stop import PauseRequest, StopRequest
from beamline.core.text import count, spans
from beamline.monitor.check import Flag, Level, Policy
from beamline.monitor.checks import flagged_frames
from beamline.plan.plan import Retake
from drivers.base.frame import Frame, FrameKind


class FlaggedFrames:
    """The flags of the frames so far.

    Args:
        sink: gets the event `FrameFlagged` if a check begins to flag or its level changes, but not for every frame.
            react: function that gets the flags of each frame. retaken_warnings: checks whose warnings also cause
            projections to be taken again.

    Attributes:
        retaken: projections that were taken again.
    """

    def __init__(
        self,
        sink: Sink,
        react: Callable[[tuple[Flag, ...]], None] = lambda flags: None,
        retaken_warnings: frozenset[str] = frozenset(),
    ) -> None:
        self._sink, self._react, self._retaken_warnings = sink, react, retaken_warnings
        self._flags: list[Flag] = []
        self._unchecked: list[int] = []  # rows
        self._active: set[tuple[str, Level]] = set()
        self._triggers: dict[int, int] = {}  # triggers of the projections, by row
        self._replaced: set[int] = set()
        self.retaken = 0

    def add(self, frame: Frame, flags: tuple[Flag, ...] | None) -> None:
        """The next frame, in the order of the file. None: the monitor did not check it."""
        if flags is None:
            self._unchecked.append(frame.index)
            flags = ()
        self._flags += [replace(flag, advice="") for flag in flags]
        if frame.kind is FrameKind.PROJECTION:
            self._triggers[frame.index] = frame.trigger
        if frame.replaces >= 0:
            self._replaced.add(frame.replaces)
            self.retaken += frame.kind is FrameKind.PROJECTION
        active = {(flag.check, flag.level) for flag in flags}
        for flag in flags:
            if (flag.check, flag.level) not in self._active:
                self._sink(FrameFlagged(flag))
        self._active = active
        self._react(flags)

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """The number of frames by check, then by level."""
        flagged: dict[str, dict[str, int]] = {}
        for (check, level), frames in sorted(flagged_frames(self._flags).items()):
            flagged.setdefault(check, {})[str(level)] = len(frames)
        return flagged

    @property
    def alarmed(self) -> set[int]:
        """Frames with an alarm of any check, except projections that were taken again."""
        return self._frames(lambda flag: flag.level is Level.ALARM)

    @property
    def alarmed_views(self) -> set[int]:
        """The projections among the frames with an alarm."""
        return self.alarmed & self._triggers.keys()

    @property
    def views_to_retake(self) -> list[Retake]:
        """Projections with an alarm, or with a warning that requires taking them again, each with the trigger that
        takes it again."""
        warned = self._frames(lambda flag: flag.level is Level.WARN and flag.check in self._retaken_warnings)
        return [Retake(row, self._triggers[row]) for row in sorted((self.alarmed | warned) & self._triggers.keys())]

    def unchecked(self, path: Path) -> str:
        """Frames that the monitor has not checked, in words, for the file at `path`; "" if it has checked all so
        far."""
        if not self._unchecked:
            return ""
        frames = f"{count(len(self._unchecked), 'frame')} ({spans(self._unchecked)})"
        return (
            f"The monitor did not check {frames}, so these frames have no flags. `beamline monitor {path}` checks "
            "all frames."
        )

    def _frames(self, which: Callable[[Flag], bool]) -> set[int]:
        """Frames with such a flag, without those that were taken again."""
        return {frame for flag in self._flags if which(flag) for frame in flag.frames} - self._replaced


class AlarmReaction:
    """Carries out the effects of the monitor's alarms on a scan.

    Args:
        act_after: number of consecutive frames with an alarm of a check after which its policy is carried out (and
            again after the same number). policies: the policies by the name of the check.
    """

    def __init__(
        self, act_after: int, policies: Mapping[str, Policy], stop: StopRequest, pause: PauseRequest, sink: Sink
    ) -> None:
        self._act_after, self._policies = act_after, policies
        self._stop, self._pause, self._sink = stop, pause, sink
        self._in_a_row: Counter[str] = Counter()

    def __call__(self, flags: tuple[Flag, ...]) -> None:
        """Record the flags of the next frame, and act."""
        alarms = [flag for flag in flags if flag.level is Level.ALARM]
        self._in_a_row = Counter({flag.check: self._in_a_row[flag.check] + 1 for flag in alarms})
        for flag in alarms:
            if self._in_a_row[flag.check] % self._act_after == 0:
                self._act(flag)

    def _act(self, flag: Flag) -> None:
        n = self._in_a_row[flag.check]
        frames = f"{n} consecutive frames" if n > 1 else "1 frame"
        advice = flag.advice.rstrip(".")
        reason = f"the check `{flag.check}` of the monitor raised an alarm for {frames}: {advice}"
        match self._policies.get(flag.check, Policy.LOG):
            case Policy.WARN:
                self._sink(Warned(f"{reason}."))
            case Policy.PAUSE:
                self._pause.pause(reason)
            case Policy.STOP if not self._stop.stopping:
                self._stop.stop(reason, by_itself=True)
