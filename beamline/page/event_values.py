"""event_values: what an event of a log says of the state of its run, for those who serve it to a control system."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Protocol

Event = Mapping[str, Any]


class Flagged(Protocol):
    """Flags of the monitor that were counted before an event."""

    @property
    def warnings(self) -> int: ...

    @property
    def alarms(self) -> int: ...


def event_values(before: Flagged, event: Event) -> dict[str, Any]:
    """The values that an event sets, by name; {} if it sets none. Numbers that are not known are NaN.

    Raises:
        KeyError: the event lacks a field.
    """
    values = _BY_KIND.get(str(event.get("event")))
    return {} if values is None else values(before, event)


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _run(before: Flagged, event: Event) -> dict[str, Any]:
    return {
        "run": str(event["folder"]), "sample": str(event["sample"]), "file": str(event["path"]),
        "planned": int(event["n_frames"]), "warnings": 0, "alarms": 0,
    }  # fmt: skip


def _state(before: Flagged, event: Event) -> dict[str, Any]:
    if event.get("source") == "recon":  # of the live volume
        return {}
    return {"state": str(event["state"]), "message": str(event.get("message", ""))}


def _frame(before: Flagged, event: Event) -> dict[str, Any]:
    return {
        "exposed": int(event["n"]), "rate": _number(event["frames_per_s"]), "data_rate": _number(event["mb_per_s"]),
        "time_left": _number(event["eta_s"]), "mean": _number(event.get("mean")),
    }  # fmt: skip


def _flag(before: Flagged, event: Event) -> dict[str, Any]:
    if "check" not in event:  # a rule of the file
        return {}
    newest_flag = {"last_flag": f"{event['check']} {event['level']}, frame {event['frame']}: {event['advice']}"}
    counted = {"alarm": {"alarms": before.alarms + 1}, "warn": {"warnings": before.warnings + 1}}
    return {**newest_flag, **counted.get(event["level"], {})}


_BY_KIND: dict[str, Callable[[Flagged, Event], dict[str, Any]]] = {
    "run_started": _run,
    "state": _state,
    "frame": _frame,
    "flag": _flag,
    "beam": lambda before, event: {"beam": _number(event["value"])},
    "warning": lambda before, event: {"message": str(event["message"])},
    "failed": lambda before, event: {} if "source" in event else {"message": str(event["message"])},
    "snapshot": lambda before, event: {"views": int(event["n_views"]), "residual": _number(event.get("unlearnt"))},
    "scan_done": lambda before, event: {"time_left": 0.0, "rate": math.nan, "data_rate": math.nan},
}
