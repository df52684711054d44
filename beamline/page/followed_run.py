"""The newest run of a folder for control systems: its values, each with a time and an alarm state."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import IntEnum
from pathlib import Path
from typing import Any

from beamline.core.errors import ConfigError, DataError, user_message
from beamline.core.event_lines import event_in
from beamline.core.text import one_line
from beamline.page.recording import Recording
from beamline.page.run_files import Reader, watched
from beamline.plan.passes import Choice
from beamline.scan.control import State
from beamline.scan.runs import newest
from beamline.storage.hdf5 import NotReadyError
from beamline.storage.run_record import DIED

Event = Mapping[str, Any]
PERIOD = 0.5  # s between two readings of the run
LONGEST = 1000  # largest number of characters of a text


def published(name: str, about: str, default: Any, unit: str = "") -> Any:
    """A field that control systems get under this name, with its meaning and unit as metadata."""
    return field(default=default, metadata={"name": name, "about": about, "unit": unit})


@dataclass(frozen=True)
class RunValues:
    """The current values of a run for control systems. Unknown numbers are NaN or -1.

    If tomoscan (APS) has the same value, the name is the same.
    """

    run: str = published("Run", "folder of the run", "")
    sample: str = published("SampleName", "name of the sample", "")
    file: str = published("FileName", "scan file", "")
    state: str = published("ScanStatus", "idle, preparing, darks, flats, acquiring, paused, done, died ...", "idle")
    message: str = published("Message", "last message of the scan", "")
    planned: int = published("ImagesPlanned", "total number of frames of the scan", -1)
    exposed: int = published("ImagesCollected", "frames exposed", 0)
    stored: int = published("ImagesSaved", "frames in the file", 0)
    percent: float = published("PercentComplete", "share of the planned frames in the file", 0.0, "%")
    rate: float = published("FrameRate", "frames per second", math.nan, "Hz")
    time_left: float = published("RemainingTime", "time until the last frame", math.nan, "s")
    mean: float = published("MeanCounts", "mean counts of the newest frame", math.nan, "counts")
    beam: float = published("Beam", "last reading of the beam monitor", math.nan)
    warnings: int = published("Warnings", "warnings of the monitor", 0)
    alarms: int = published("Alarms", "alarms of the monitor", 0)
    last_flag: str = published("LastFlag", "check, frame and advice of the last flag", "")
    views: int = published("ReconViews", "projections in the live volume", 0)
    free: float = published("DiskFree", "free space of the disk with the scan file", math.nan, "GB")
    age: float = published("FrameAge", "time since the last frame arrived in the file", math.nan, "s")
    data_rate: float = published("DataRate", "data per second", math.nan, "MB/s")
    residual: float = published(
        "ReconResidual", "relative residual of new projections before the live fit has used them", math.nan
    )
    skipped: int = published("SkippedLines", "messages in the log that are not events", 0)
    angle: float = published("Angle", "rotation angle of the newest frame in the file", math.nan, "deg")
    flag_names: tuple[str, ...] = published("FlagNames", "checks of the monitor that flagged frames", ())
    flag_counts: tuple[int, ...] = published("FlagCounts", "flags of each check in FlagNames", ())
    pass_number: int = published("PassNumber", "number of the last finished pass of projections, from 1", 0)
    options: tuple[str, ...] = published(
        "Options", "choices of what to measure after this pass: next, again, offset, retake, enough", ()
    )
    option_gains: tuple[float, ...] = published(
        "OptionGains", "predicted improvement by each choice in Options", (), "dB"
    )
    option_lows: tuple[float, ...] = published("OptionGainsLow", "lower ends of OptionGains", (), "dB")
    option_highs: tuple[float, ...] = published("OptionGainsHigh", "upper ends of OptionGains", (), "dB")
    option_times: tuple[float, ...] = published("OptionTimes", "time that each choice in Options needs", (), "s")
    option_doses: tuple[float, ...] = published(
        "OptionDoses", "dose of each choice in Options, in per cent of the dose of the whole plan", (), "%"
    )
    option_sizes: tuple[float, ...] = published("OptionSizes", "size of the data of each choice in Options", (), "GB")
    recommended: str = published(
        "Recommended", "the choice in Options that the program recommends, and takes if the scan decides by itself", ""
    )
    wait: float = published(
        "AnswerWithin",
        "time left for the operator to decide what is next; 0: the scan does not wait for a decision",
        0.0,
        "s",
    )
    decision: str = published("Decision", "the last choice, who made it, and the reason", "")
    predicted_gain: float = published(
        "PredictedGain", "predicted improvement of the newest choice whose improvement was measured", math.nan, "dB"
    )
    measured_gain: float = published(
        "MeasuredGain", "measured improvement of the newest choice whose improvement was measured", math.nan, "dB"
    )


def choice_of(values: RunValues, word: str) -> Choice:
    """The choice that a word of the operator stands for. Raises ConfigError if this choice is not possible now."""
    if word in values.options and word in [*Choice]:  # the log of another version may have other choices
        return Choice(word)
    offer = f"possible: {', '.join(values.options)}" if values.options else "no pass has ended yet"
    raise ConfigError(f"{one_line(word)!r} cannot be chosen now; {offer}. Nothing was changed.")


class Severity(IntEnum):
    """Severities of alarms, as in EPICS."""

    NO_ALARM = 0
    MINOR = 1
    MAJOR = 2
    INVALID = 3


@dataclass(frozen=True)
class Stamp:
    """The time of a value in s since the Unix epoch, and its alarm."""

    time: float
    severity: Severity = Severity.NO_ALARM
    message: str = ""


@dataclass(frozen=True)
class StampedValues:
    """Values of a run, each with a stamp from the event, or from the frame, that set the value last.

    Attributes:
        began: time stamp of values that were never set, in s since the Unix epoch.
        unread: why the file can no longer be read, so that its values are old; "" if the file can be read.
    """

    values: RunValues
    began: float
    stamps: Mapping[str, Stamp] = field(default_factory=dict)
    unread: str = ""

    def stamp(self, name: str) -> Stamp:
        """The stamp of a value. It is INVALID if the value is unknown, or comes from a file that cannot be read."""
        value, stamp = getattr(self.values, name), self.stamps.get(name, Stamp(self.began))
        if value == -1 or value != value:
            return replace(stamp, severity=Severity.INVALID, message="not known")
        if self.unread and name in _OF_FILE:
            return replace(stamp, severity=Severity.INVALID, message=self.unread)
        return stamp

    def after(self, lines: Iterable[str]) -> StampedValues:
        """The values after further lines of the log."""
        values, stamps = self.values, dict(self.stamps)
        for line in lines:
            event = event_in(line) or {}
            # a field is missing, or has another type
            with suppress(LookupError, TypeError, ValueError, ArithmeticError):
                event_time, severity = float(event["time"]), _severity(event)
                values_of_event = event_values(values, event)
                texts = {
                    name: one_line(value, LONGEST) for name, value in values_of_event.items() if isinstance(value, str)
                }
                values = replace(values, **{**values_of_event, **texts})
                for name in values_of_event:
                    worst = severity if name in _ALARMED else Severity.NO_ALARM
                    stamps[name] = Stamp(event_time, worst, values.message if worst else "")
        return replace(self, values=values, stamps=stamps)

    def with_file(self, seen: Mapping[str, Any], angle: float, now: float) -> StampedValues:
        """The values, updated with those of the file at the time `now`.

        Args:
            seen: see `page.run_files.Reader.state`.
            angle: angle of the newest frame in degrees.
        """
        before, stored, status = self.values, int(seen["frames"]), str(seen["status"])
        frame = Stamp(now if seen["newest"] is None else float(seen["newest"]))
        taken: dict[str, Any] = {"stored": stored, "angle": angle, "free": seen["free"] / 1e9, "age": seen["age_s"]}
        taken["exposed"] = max(before.exposed, stored)  # not every frame has an event
        taken["percent"] = 100.0 * stored / max(before.planned, stored) if before.planned > 0 else before.percent
        taken["skipped"] = seen.get("skipped_lines", 0)
        stamps = {**self.stamps, **dict.fromkeys(_OF_FILE, frame), "free": Stamp(now), "age": Stamp(now)}
        # because no log may state it
        ended = status == DIED or seen.get("over") or (not before.run and status != "running")
        if ended and status != before.state:
            reason = one_line(seen["next"], LONGEST)
            taken |= {"state": status, "message": reason, "wait": 0.0}
            stamps["state"] = stamps["message"] = Stamp(now, _OF_STATE.get(status, Severity.NO_ALARM), reason)
        return replace(self, values=replace(before, **taken), stamps=stamps, unread="")


_OF_FILE = ("stored", "percent", "angle", "free", "age")
_ALARMED = ("state", "message", "last_flag", "warnings", "alarms")
"""The values whose severity is that of the event that set them."""
_OF_STATE: Mapping[str, Severity] = {
    State.FAILED: Severity.MAJOR, DIED: Severity.MAJOR, State.ABORTED: Severity.MAJOR,
    State.STOPPED: Severity.MINOR, State.PAUSED: Severity.MINOR, State.ASKING: Severity.MINOR,
}  # fmt: skip
_OF_LEVEL = {"alarm": Severity.MAJOR, "warn": Severity.MINOR}


def _severity(event: Event) -> Severity:
    """The severity of an event, which depends on its state, level or kind."""
    kind = event["event"]
    if kind == "state":
        return _OF_STATE.get(event["state"], Severity.NO_ALARM)
    if kind == "flag":
        return _OF_LEVEL.get(event.get("level", ""), Severity.NO_ALARM)
    return {"failed": Severity.MAJOR, "warning": Severity.MINOR}.get(kind, Severity.NO_ALARM)


class FollowedRun:
    """The newest run of a folder. If a newer run begins, the object follows that run. Calls may come from any thread.

    Args:
        now: a clock, s since the Unix epoch.

    Attributes:
        stamped: the values of the run at the last look.
    """

    def __init__(self, runs: Path, now: Callable[[], float] = time.time) -> None:
        self.runs, self._now = runs, now
        self._lock = threading.Lock()
        self._reader: Reader | None = None
        self._lines = 0
        self.stamped = StampedValues(RunValues(), now())

    def close(self) -> None:
        with self._lock:
            if self._reader is not None:
                self._reader.close()
                self._reader = None

    def reader(self) -> Reader:
        """The reader of the run's files. Raises DataError if there is no run yet."""
        with self._lock:
            if self._reader is None:
                raise DataError("There is no run yet.")
            return self._reader

    def look(self) -> StampedValues:
        """The current values."""
        with self._lock:
            with suppress(ConfigError, DataError):  # there has been no run so far
                self.stamped = self._read()
            return self.stamped

    def _read(self) -> StampedValues:
        watched_run, stamped = watched(newest(self.runs)), self.stamped
        if self._reader is None or self._reader.what != watched_run:
            if self._reader is not None:
                self._reader.close()
            self._reader, self._lines = Reader(watched_run), 0
            stamped = StampedValues(RunValues(), self._now())
        seen, angle, reason = None, math.nan, ""
        try:
            seen = self._reader.state()
            angle = self._reader.do(_newest_angle) if seen["frames"] else math.nan
        except (DataError, NotReadyError, OSError) as error:
            reason = user_message(error)
        lines = self._reader.events.lines
        stamped, self._lines = stamped.after(lines[self._lines :]), len(lines)
        return replace(stamped, unread=reason) if seen is None else stamped.with_file(seen, angle, self._now())


def _newest_angle(recording: Recording) -> float:
    """The angle in degrees."""
    angles = recording.columns(max(recording.progress().frames - 1, 0))["angle"]
    return math.nan if not angles or angles[-1] is None else float(angles[-1])


def event_values(before: RunValues, event: Event) -> dict[str, Any]:
    """The values that an event sets, by name; {} if the event sets none. Unknown numbers are NaN.

    Raises:
        LookupError, TypeError, ValueError, ArithmeticError: a field of the event is missing, or has another type.
    """
    values = _BY_KIND.get(str(event.get("event")))
    return {} if values is None else values(before, event)


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _run(before: RunValues, event: Event) -> dict[str, Any]:
    return {
        "run": str(event["folder"]), "sample": str(event["sample"]), "file": str(event["path"]),
        "planned": int(event["n_frames"]), "warnings": 0, "alarms": 0, "flag_names": (), "flag_counts": (),
    }  # fmt: skip


def _state(before: RunValues, event: Event) -> dict[str, Any]:
    if event.get("source") == "recon":  # of the live volume
        return {}
    nobody_is_asked = {"wait": 0.0} if event["state"] == State.FINISHING else {}
    return {"state": str(event["state"]), "message": str(event.get("message", "")), **nobody_is_asked}


def _frame(before: RunValues, event: Event) -> dict[str, Any]:
    return {
        "exposed": int(event["n"]), "rate": _number(event["frames_per_s"]), "data_rate": _number(event["mb_per_s"]),
        "time_left": _number(event["eta_s"]), "mean": _number(event.get("mean")),
    }  # fmt: skip


def _flag(before: RunValues, event: Event) -> dict[str, Any]:
    if "check" not in event:  # a rule of the file
        return {}
    counts = Counter(dict(zip(before.flag_names, before.flag_counts, strict=True)))
    counts[str(event["check"])] += 1
    last = f"{event['check']} {event['level']}, frame {event['frame']}: {event['advice']}"
    counted = {"alarm": {"alarms": before.alarms + 1}, "warn": {"warnings": before.warnings + 1}}
    names = {"last_flag": last, "flag_names": (*counts,), "flag_counts": (*counts.values(),)}
    return {**names, **counted.get(event["level"], {})}


def _pass(before: RunValues, event: Event) -> dict[str, Any]:
    def of_options(name: str, factor: float = 1.0) -> tuple[float, ...]:
        return tuple(factor * _number(option[name]) for option in event["options"])

    return {
        "pass_number": int(event.get("passes", event["number"])), "wait": _number(event.get("wait", 0.0)),
        "options": tuple(one_line(str(option["choice"])) for option in event["options"]),
        "option_gains": of_options("gain"), "option_lows": of_options("low"), "option_highs": of_options("high"),
        "option_times": of_options("seconds"), "option_doses": of_options("dose", 100.0),
        "option_sizes": of_options("bytes", 1e-9), "recommended": str(event["recommended"]),
    }  # fmt: skip


def _chosen(before: RunValues, event: Event) -> dict[str, Any]:
    return {
        "wait": 0.0, "decision": f"{event['choice']}, by the {event['by']}: {event['reason']}",
        "predicted_gain": _number(event.get("predicted")), "measured_gain": _number(event.get("gained")),
    }  # fmt: skip


_BY_KIND: dict[str, Callable[[RunValues, Event], dict[str, Any]]] = {
    "run_started": _run,
    "state": _state,
    "frame": _frame,
    "flag": _flag,
    "beam": lambda before, event: {"beam": _number(event["value"])},
    "warning": lambda before, event: {"message": str(event["message"])},
    "failed": lambda before, event: {} if "source" in event else {"message": str(event["message"])},
    "snapshot": lambda before, event: {"views": int(event["n_views"]), "residual": _number(event.get("unlearnt"))},
    "pass_ended": _pass,
    "next_chosen": _chosen,
    "scan_done": lambda before, event: {"time_left": 0.0, "rate": math.nan, "data_rate": math.nan},
}
