"""Supervision: what may hold a scan or end it beside its operator, and what alarms of the monitor do to it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from beamline.core.events import Emit
from beamline.core.stop import HoldRequest, StopRequest
from beamline.monitor.check import Flag, Level, Policy
from beamline.plan.retake import Retake
from drivers.manual import Ask


def _nobody(request: str) -> None:
    """For scans that are never held."""


@dataclass(frozen=True)
class Supervision:
    """What acquisition asks while it goes on.

    Attributes:
        refusal: asked once, before the first projection, when all frames before it were taken over: why no projection
            should be taken; None: they may be.
        hold: asked before each view of a step scan and before each pass of a fly scan: why it should wait; None: it
            goes on.
        ask: puts the request to go on to the operator, and returns when it was confirmed.
        retakes: asked once, after the last projection: which to take again; is given the triggers without a frame.
    """

    refusal: Callable[[], str | None] = lambda: None
    hold: Callable[[], str | None] = lambda: None
    ask: Ask = _nobody
    retakes: Callable[[Sequence[int]], Sequence[Retake]] = lambda missing: ()


UNSUPERVISED = Supervision()


@dataclass(frozen=True)
class AlarmPolicy:
    """What alarms of the monitor do to a scan.

    Attributes:
        act_after: frames in a row with an alarm of a check, after which its policy is carried out; again after so many.
        policies: by the name of the check.
    """

    act_after: int = 10
    policies: Mapping[str, Policy] = field(default_factory=dict)


class AlarmReaction:
    """Carries out the policy while frames come."""

    def __init__(self, policy: AlarmPolicy, stop: StopRequest, hold: HoldRequest, emit: Emit) -> None:
        self._policy, self._stop, self._hold, self._emit = policy, stop, hold, emit
        self._in_a_row: Counter[str] = Counter()

    def __call__(self, flags: tuple[Flag, ...]) -> None:
        """Take note of the flags of the next frame, and act."""
        alarms = [flag for flag in flags if flag.level is Level.ALARM]
        self._in_a_row = Counter({flag.check: self._in_a_row[flag.check] + 1 for flag in alarms})
        for flag in alarms:
            if self._in_a_row[flag.check] % self._policy.act_after == 0:
                self._act(flag)

    def _act(self, flag: Flag) -> None:
        n = self._in_a_row[flag.check]
        frames = f"{n} frames in a row have" if n > 1 else "1 frame has"
        reason = f"{frames} an alarm of the monitor's {flag.check} check: {flag.advice.rstrip('.')}"
        match self._policy.policies.get(flag.check, Policy.LOG):
            case Policy.WARN:
                self._emit("warning", {"message": f"{reason}."})
            case Policy.PAUSE:
                self._hold.hold(reason)
            case Policy.STOP if not self._stop.stopping:
                self._stop.stop(reason)
