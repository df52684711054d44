"""event_values: what an event of a log says of the state of its run, for those who serve it to a control system."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

Event = Mapping[str, Any]


def published(name: str, about: str, default: Any, unit: str = "") -> Any:
    """A field that control systems see under this name, with its meaning and unit as metadata."""
    return field(default=default, metadata={"name": name, "about": about, "unit": unit})


@dataclass(frozen=True)
class RunValues:
    """The present values of a run, which every control system sees. Numbers are NaN or -1 where they are not known.

    Names that tomoscan (APS) has are as there.
    """

    run: str = published("Run", "folder of the run", "")
    sample: str = published("SampleName", "name of the sample", "")
    file: str = published("FileName", "scan file", "")
    state: str = published("ScanStatus", "idle, preparing, darks, flats, acquiring, paused, done, died ...", "idle")
    message: str = published("Message", "what the scan said last", "")
    planned: int = published("ImagesPlanned", "frames that the scan takes in all", -1)
    exposed: int = published("ImagesCollected", "frames exposed", 0)
    stored: int = published("ImagesSaved", "frames in the file", 0)
    percent: float = published("PercentComplete", "of the frames planned", 0.0, "%")
    rate: float = published("FrameRate", "frames a second", math.nan, "Hz")
    time_left: float = published("RemainingTime", "until the last frame", math.nan, "s")
    mean: float = published("MeanCounts", "of the newest frame", math.nan, "counts")
    beam: float = published("Beam", "last reading of the beam monitor", math.nan)
    warnings: int = published("Warnings", "flags of the monitor that warn", 0)
    alarms: int = published("Alarms", "flags of the monitor that are alarms", 0)
    last_flag: str = published("LastFlag", "check, frame and advice of the last flag", "")
    views: int = published("ReconViews", "views in the live volume", 0)
    free: float = published("DiskFree", "of the disk with the scan file", math.nan, "GB")
    age: float = published("FrameAge", "since the last frame came into the file", math.nan, "s")


def event_values(before: RunValues, event: Event) -> dict[str, Any]:
    """The values that an event sets, by name; {} if it sets none. Numbers that are not known are NaN.

    Raises:
        KeyError: the event lacks a field.
    """
    values = _BY_KIND.get(str(event.get("event")))
    return {} if values is None else values(before, event)


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _run(before: RunValues, event: Event) -> dict[str, Any]:
    return {
        "run": str(event["folder"]), "sample": str(event["sample"]), "file": str(event["path"]),
        "planned": int(event["n_frames"]), "warnings": 0, "alarms": 0,
    }  # fmt: skip


def _state(before: RunValues, event: Event) -> dict[str, Any]:
    if event.get("source") == "recon":  # of the live volume
        return {}
    return {"state": str(event["state"]), "message": str(event.get("message", ""))}


def _frame(before: RunValues, event: Event) -> dict[str, Any]:
    return {
        "exposed": int(event["n"]), "rate": _number(event["frames_per_s"]), "data_rate": _number(event["mb_per_s"]),
        "time_left": _number(event["eta_s"]), "mean": _number(event.get("mean")),
    }  # fmt: skip


def _flag(before: RunValues, event: Event) -> dict[str, Any]:
    if "check" not in event:  # a rule of the file
        return {}
    newest_flag = {"last_flag": f"{event['check']} {event['level']}, frame {event['frame']}: {event['advice']}"}
    counted = {"alarm": {"alarms": before.alarms + 1}, "warn": {"warnings": before.warnings + 1}}
    return {**newest_flag, **counted.get(event["level"], {})}


_BY_KIND: dict[str, Callable[[RunValues, Event], dict[str, Any]]] = {
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
