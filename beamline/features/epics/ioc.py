"""Process variables of the newest run of a folder, by PVAccess (p4p); with --control also the verbs to it."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from pathlib import Path
from typing import Any

from beamline.core.errors import BeamlineError, ConfigError, DataError, user_message
from beamline.core.events import event_in
from beamline.core.text import one_line
from beamline.page.event_values import RunValues, event_values, published
from beamline.page.run_files import Reader, watched
from beamline.scan.control import Asked, Verb, ask
from beamline.scan.runs import DIED, newest
from beamline.scan.states import State
from beamline.storage.hdf5 import NotReadyError


@dataclass(frozen=True)
class ProcessVariables(RunValues):
    """The values of a run that are process variables."""

    data_rate: float = published("DataRate", "data a second", math.nan, "MB/s")
    residual: float = published("ReconResidual", "of the views that the live volume has not learnt", math.nan)
    skipped: int = published("SkippedLines", "lines of the log that are no events", 0)


class Severity(IntEnum):
    """Severities of EPICS alarms."""

    NO_ALARM = 0
    MINOR = 1
    MAJOR = 2
    INVALID = 3


@dataclass(frozen=True)
class Stamp:
    """When a value was so, s since the Unix epoch, and its alarm."""

    time: float
    severity: Severity = Severity.NO_ALARM
    message: str = ""


@dataclass(frozen=True)
class StampedValues:
    """Values of a run, each with its stamp: of the event, or of the frame, that set it last.

    Attributes:
        began: stamp of what nothing has set yet.
    """

    values: ProcessVariables
    began: float
    stamps: Mapping[str, Stamp] = field(default_factory=dict)

    def stamp(self, name: str) -> Stamp:
        """The stamp of a value: INVALID where the value is not known."""
        value, stamp = getattr(self.values, name), self.stamps.get(name, Stamp(self.began))
        unknown = value == -1 or value != value
        return replace(stamp, severity=Severity.INVALID, message="not known") if unknown else stamp

    def after(self, lines: Iterable[str]) -> StampedValues:
        """The values after these further lines of the log."""
        values, stamps = self.values, dict(self.stamps)
        for line in lines:
            event = event_in(line) or {}
            with suppress(KeyError):  # a field is not there
                at, taken, severity = float(event["time"]), event_values(values, event), _severity(event)
                values = replace(values, **taken)
                for name in taken:
                    worst = severity if name in _ALARMED else Severity.NO_ALARM
                    stamps[name] = Stamp(at, worst, values.message if worst else "")
        return replace(self, values=values, stamps=stamps)

    def with_file(self, seen: Mapping[str, Any], now: float) -> StampedValues:
        """The same with what the file says at the time `now`: `page.run_files.Reader.state`."""
        before, stored, status = self.values, int(seen["frames"]), str(seen["status"])
        state = status if status == DIED or (not before.run and status != "running") else before.state
        percent = 100.0 * stored / before.planned if before.planned > 0 else before.percent
        frame = Stamp(now if seen["newest"] is None else float(seen["newest"]))
        stamps = {**self.stamps, "stored": frame, "percent": frame, "free": Stamp(now), "age": Stamp(now)}
        if state != before.state:
            stamps["state"] = Stamp(now, _OF_STATE.get(state, Severity.NO_ALARM), str(seen["next"]))
        values = replace(
            before,
            stored=stored,
            percent=percent,
            state=state,
            free=seen["free"] / 1e9,
            age=seen["age_s"],
            skipped=seen.get("skipped_lines", 0),
        )
        return replace(self, values=values, stamps=stamps)

    def unreadable(self, why: str) -> StampedValues:
        """The same where the file cannot be read: what it says is as old as its stamp, and INVALID."""
        old = {name: replace(self.stamp(name), severity=Severity.INVALID, message=why) for name in _OF_FILE}
        return replace(self, stamps={**self.stamps, **old})


_OF_FILE = ("stored", "percent", "free", "age")
_ALARMED = ("state", "message", "last_flag", "warnings", "alarms")
"""Values whose severity is that of the event that set them."""
_OF_STATE = {
    State.FAILED: Severity.MAJOR, DIED: Severity.MAJOR, State.ABORTED: Severity.MAJOR,
    State.STOPPED: Severity.MINOR, State.PAUSED: Severity.MINOR,
}  # fmt: skip
_OF_LEVEL = {"alarm": Severity.MAJOR, "warn": Severity.MINOR}


def _severity(event: Mapping[str, Any]) -> Severity:
    """The severity of an event, by its state, level or kind."""
    kind = event["event"]
    if kind == "state":
        return _OF_STATE.get(event["state"], Severity.NO_ALARM)
    if kind == "flag":
        return _OF_LEVEL.get(event.get("level", ""), Severity.NO_ALARM)
    return {"failed": Severity.MAJOR, "warning": Severity.MINOR}.get(kind, Severity.NO_ALARM)


_DEVICE, _UNDEFINED = 1, 6  # alarm_t.status of EPICS's normative types
_LONGEST = 1000  # characters of a text
PERIOD = 0.5  # s between two looks at the run
_TYPES: dict[str, str] = {"str": "s", "int": "l", "float": "d"}


class RunServer:
    """Serves the newest run of a folder, also one that begins later, until it is closed.

    Args:
        prefix: before each name, such as "2bma:splatline:".
        address: to listen at.
        control: verbs are taken, from everybody who reaches the address.
        say: takes a line for each verb.
        now: a clock, s since the Unix epoch.

    Raises:
        ConfigError: p4p is not installed.
        DataError: the address cannot be listened at.
    """

    def __init__(
        self,
        runs: Path,
        prefix: str,
        address: str,
        control: bool,
        say: Callable[[str], None],
        now: Callable[[], float] = time.time,
    ) -> None:
        try:
            from p4p.nt import NTScalar
            from p4p.server import Server, StaticProvider
            from p4p.server.thread import SharedPV
        except ImportError as error:
            raise ConfigError(
                'EPICS needs the library p4p: pip install "splatline[epics]". Nothing was started.'
            ) from error
        self._runs, self._say, self._now = runs, say, now
        self._reader: Reader | None = None
        self._values, self._lines, self._beats = StampedValues(ProcessVariables(), now()), 0, 0
        self._asked: deque[tuple[Any, Any, Asked]] = deque()  # PVs whose clients wait, with their operations
        provider, self._shown = StaticProvider("splatline"), dict[str, Any]()
        for each in fields(ProcessVariables):
            about = {"display.description": each.metadata["about"], "display.units": each.metadata["unit"]}
            kind = NTScalar(_TYPES[str(each.type)], display=True)
            initial = _posted(each.default, self._values.stamp(each.name))
            self._shown[each.name] = pv = SharedPV(nt=kind, initial={**initial, **about})
            provider.add(prefix + each.metadata["name"], pv)
        begun = Stamp(now())
        self._heartbeat = SharedPV(nt=NTScalar("l"), initial=_posted(0, begun))
        provider.add(prefix + "Heartbeat", self._heartbeat)
        untold = _posted(False, begun)
        self._verbs = {verb: SharedPV(nt=NTScalar("?"), initial=untold) for verb in (Verb if control else ())}
        for verb, pv in self._verbs.items():
            pv.put(self._verb(verb))
            provider.add(f"{prefix}{verb.value.capitalize()}Scan", pv)
        try:
            self._server = Server(providers=[provider], conf={"EPICS_PVAS_INTF_ADDR_LIST": address})
        except RuntimeError as error:
            raise DataError(f"{address} cannot be listened at: {error}. Nothing was started.") from error

    @property
    def configuration(self) -> dict[str, str]:
        """Addresses and ports of the server, as EPICS names them."""
        return dict(self._server.conf())

    def look(self) -> None:
        """Answer clients whose verbs are done. Look at the run, and post what has been set since, with the time and the
        alarm of what set it."""
        for _ in range(len(self._asked)):
            self._answer(*self._asked.popleft())
        now, before = self._read(), self._values
        for each in fields(ProcessVariables):
            value, stamp = getattr(now.values, each.name), now.stamp(each.name)
            known = getattr(before.values, each.name)
            same = value == known or (value != value and known != known)  # NaN is not equal to itself
            if not same or stamp != before.stamp(each.name):
                self._shown[each.name].post(_posted(value, stamp))
        self._values = now
        self._beats += 1
        self._heartbeat.post(_posted(self._beats, Stamp(self._now())))

    def close(self) -> None:
        self._server.stop()
        if self._reader is not None:
            self._reader.close()

    def _read(self) -> StampedValues:
        try:
            run = newest(self._runs)
        except ConfigError:
            return self._values  # no run so far
        values = self._values
        what = watched(run)
        if self._reader is None or self._reader.what != what:
            if self._reader is not None:
                self._reader.close()
            self._reader, self._lines = Reader(what), 0
            values = StampedValues(ProcessVariables(), self._now())
        seen, why = None, ""
        try:
            seen = self._reader.state()
        except (DataError, NotReadyError, OSError) as error:
            why = user_message(error)
        lines = self._reader.events.lines
        values = values.after(lines[self._lines :])
        self._lines = len(lines)
        return values.unreadable(why) if seen is None else values.with_file(seen, self._now())

    def _verb(self, verb: Verb) -> Callable[[Any, Any], None]:
        """A handler of a PV: true sends the verb to the run at once, and the PV is false again. `look` answers the
        client when the verb is done: a verb never waits for another one."""

        def put(pv: Any, op: Any) -> None:
            if not bool(op.value()):
                op.done()
                return
            self._say(f"{verb} from {op.peer()}")
            try:
                self._asked.append((pv, op, ask(newest(self._runs), verb)))
            except (BeamlineError, OSError) as error:
                self._refuse(pv, op, error)

        return put

    def _answer(self, pv: Any, op: Any, asked: Asked) -> None:
        """Answer the client of a verb that is done; one that is not yet waits for the next look."""
        try:
            done = asked.state() is not None
        except (BeamlineError, OSError) as error:
            self._refuse(pv, op, error)
            return
        if done:
            pv.post(_posted(False, Stamp(self._now())))
            op.done()
        else:
            self._asked.append((pv, op, asked))

    def _refuse(self, pv: Any, op: Any, error: Exception) -> None:
        stamp = Stamp(self._now(), Severity.MAJOR, user_message(error))
        pv.post(_posted(False, stamp))
        op.done(error=stamp.message)


def _posted(value: Any, stamp: Stamp) -> dict[str, Any]:
    """A value with its time and alarm, in the fields of an NTScalar."""
    seconds = math.floor(stamp.time)
    return {
        "value": one_line(value, _LONGEST) if isinstance(value, str) else value,
        "timeStamp.secondsPastEpoch": seconds,
        "timeStamp.nanoseconds": min(999_999_999, round(1e9 * (stamp.time - seconds))),
        "alarm.severity": int(stamp.severity),
        "alarm.status": _UNDEFINED if stamp.severity is Severity.INVALID else _DEVICE if stamp.severity else 0,
        "alarm.message": one_line(stamp.message, _LONGEST),
    }
