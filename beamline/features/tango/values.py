"""The present values of a run as attributes of a Tango device, by its log of events and its scan file."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from typing import Any

from beamline.core.events import event_in
from beamline.core.text import one_line
from beamline.page.event_values import RunValues, event_values, published
from beamline.scan.runs import DIED
from beamline.scan.states import State

_LONGEST = 1000  # characters of a text


@dataclass(frozen=True)
class ScanAttributes(RunValues):
    """The values of a run that are attributes of the device, by the names of the process variables (docs/epics.md)."""

    angle: float = published("Angle", "of the newest frame in the file", math.nan, "deg")
    flag_names: tuple[str, ...] = published("FlagNames", "checks of the monitor that flagged frames", ())
    flag_counts: tuple[int, ...] = published("FlagCounts", "flags of each of FlagNames", ())

    @property
    def device_state(self) -> str:
        """The name of Tango's state: RUNNING, ALARM where the monitor has alarms, STANDBY while the scan is paused, ON
        when none runs, FAULT after one that ended badly."""
        if self.state in (State.FAILED, State.ABORTED, DIED):
            return "FAULT"
        if self.state == State.PAUSED:
            return "STANDBY"
        if self.state == State.PREPARING:
            return "INIT"
        if self.state in (State.IDLE, State.DONE, State.STOPPED):
            return "ON"
        return "ALARM" if self.alarms else "RUNNING"


@dataclass(frozen=True)
class TimedAttributes:
    """Values of a run with the time of what set each last, s since the Unix epoch.

    Attributes:
        began: time of what nothing has set yet.
        unread: the values of the file are old, because it cannot be read any more.
    """

    values: ScanAttributes
    began: float
    times: Mapping[str, float] = field(default_factory=dict)
    unread: bool = False

    def quality(self, name: str) -> str:
        """The name of Tango's quality of a value: INVALID where it is not known or old."""
        value = getattr(self.values, name)
        if (isinstance(value, int | float) and (value == -1 or value != value)) or (self.unread and name in OF_FILE):
            return "ATTR_INVALID"
        if value and name in _RAISED:
            return _RAISED[name]
        return "ATTR_VALID"

    def time(self, name: str) -> float:
        return self.times.get(name, self.began)

    def after(self, lines: Iterable[str]) -> TimedAttributes:
        """The values after these further lines of the log."""
        values, times = self.values, dict(self.times)
        for line in lines:
            event = event_in(line) or {}
            with suppress(KeyError):  # a field is not there
                taken = _taken(values, event)
                times |= dict.fromkeys(taken, float(event["time"]))
                values = replace(values, **taken)
        return replace(self, values=values, times=times)

    def with_file(self, seen: Mapping[str, Any], angle: float, now: float) -> TimedAttributes:
        """The same with what the file says at the time `now`.

        Args:
            seen: see `page.run_files.Reader.state`.
            angle: of the newest frame, degrees.
        """
        before, stored, status = self.values, int(seen["frames"]), str(seen["status"])
        taken: dict[str, Any] = {"stored": stored, "angle": angle, "free": seen["free"] / 1e9, "age": seen["age_s"]}
        if before.planned > 0:
            taken["percent"] = 100.0 * stored / before.planned
        if status == DIED or (not before.run and status != "running"):  # the log does not say how it ended
            taken |= {"state": status, "message": str(seen["next"])}
        newest = now if seen["newest"] is None else float(seen["newest"])
        times = {**dict.fromkeys(taken, now), **dict.fromkeys(("stored", "angle", "percent"), newest)}
        if taken.get("state") == before.state:
            times["state"] = times["message"] = self.time("state")
        return replace(self, values=replace(before, **taken), times={**self.times, **times}, unread=False)


OF_FILE = ("stored", "percent", "angle", "free", "age")
_RAISED = {"warnings": "ATTR_WARNING", "alarms": "ATTR_ALARM"}


def _taken(now: ScanAttributes, event: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes that an event sets. KeyError: it lacks a field."""
    taken = event_values(now, event)
    if event.get("event") == "run_started":
        taken |= {"flag_names": (), "flag_counts": ()}
    elif "last_flag" in taken:
        counts = Counter(dict(zip(now.flag_names, now.flag_counts, strict=True)))
        counts[str(event["check"])] += 1
        taken |= {"flag_names": (*counts,), "flag_counts": (*counts.values(),)}
    texts = {name: one_line(value, _LONGEST) for name, value in taken.items() if isinstance(value, str)}
    return {name: value for name, value in {**taken, **texts}.items() if name in _NAMES}


_NAMES = frozenset(each.name for each in fields(ScanAttributes))
