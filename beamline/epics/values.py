"""Values of a run for process variables: what the events of its log say so far."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any


def _pv(name: str, about: str, default: Any, unit: str = "") -> Any:
    return field(default=default, metadata={"pv": name, "about": about, "unit": unit})


@dataclass(frozen=True)
class RunValues:
    """The present values of a run; each field is a process variable, with its name, meaning and unit as metadata.

    Names that tomoscan (APS) has are as there. Numbers are NaN or -1 where they are not known.
    """

    run: str = _pv("Run", "folder of the run", "")
    sample: str = _pv("SampleName", "name of the sample", "")
    file: str = _pv("FileName", "scan file", "")
    state: str = _pv("ScanStatus", "idle, preparing, darks, flats, acquiring, paused, done ...", "idle")
    message: str = _pv("Message", "what the scan said last", "")
    planned: int = _pv("ImagesPlanned", "frames that the scan takes in all", -1)
    exposed: int = _pv("ImagesCollected", "frames exposed", 0)
    stored: int = _pv("ImagesSaved", "frames in the file", 0)
    percent: float = _pv("PercentComplete", "of the frames planned", 0.0, "%")
    rate: float = _pv("FrameRate", "frames a second", math.nan, "Hz")
    data_rate: float = _pv("DataRate", "data a second", math.nan, "MB/s")
    time_left: float = _pv("RemainingTime", "until the last frame", math.nan, "s")
    mean: float = _pv("MeanCounts", "of the newest frame", math.nan, "counts")
    beam: float = _pv("Beam", "last reading of the beam monitor", math.nan)
    warnings: int = _pv("Warnings", "flags of the monitor that warn", 0)
    alarms: int = _pv("Alarms", "flags of the monitor that are alarms", 0)
    last_flag: str = _pv("LastFlag", "check, frame and advice of the last flag", "")
    views: int = _pv("ReconViews", "views in the live volume", 0)
    residual: float = _pv("ReconResidual", "of the views that the live volume has not learnt", math.nan)
    free: float = _pv("DiskFree", "of the disk with the scan file", math.nan, "GB")
    age: float = _pv("FrameAge", "since the last frame came into the file", math.nan, "s")

    def after(self, lines: Iterable[str]) -> RunValues:
        """The values after these further lines of the log."""
        now = self
        for line in lines:
            event = json.loads(line)
            take = _TAKEN.get(str(event.get("event")))
            if take is not None:
                now = replace(now, **take(now, event))
        return now

    def with_file(self, seen: Mapping[str, Any]) -> RunValues:
        """The same with what the file says: `page.run_files.Reader.state`."""
        stored = int(seen["frames"])
        state = seen["status"] if not self.run and seen["status"] != "running" else self.state
        percent = 100.0 * stored / self.planned if self.planned > 0 else self.percent
        return replace(self, stored=stored, percent=percent, state=state, free=seen["free"] / 1e9, age=seen["age_s"])


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _state(now: RunValues, event: Mapping[str, Any]) -> dict[str, Any]:
    if event.get("source") == "recon":  # of the live volume
        return {}
    return {"state": str(event["state"]), "message": str(event.get("message", ""))}


def _frame(now: RunValues, event: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "exposed": int(event["n"]), "rate": _number(event["frames_per_s"]), "data_rate": _number(event["mb_per_s"]),
        "time_left": _number(event["eta_s"]), "mean": _number(event.get("mean")),
    }  # fmt: skip


def _flag(now: RunValues, event: Mapping[str, Any]) -> dict[str, Any]:
    if "check" not in event:  # a rule of the file
        return {}
    alarm = event["level"] == "alarm"
    said = f"{event['check']} {event['level']}, frame {event['frame']}: {event['advice']}"
    return {"alarms": now.alarms + alarm, "warnings": now.warnings + (not alarm), "last_flag": said}


_TAKEN = {
    "run_started": lambda now, event: {
        "run": str(event["folder"]), "sample": str(event["sample"]), "file": str(event["path"]),
        "planned": int(event["n_frames"]),
    },
    "state": _state,
    "frame": _frame,
    "flag": _flag,
    "beam": lambda now, event: {"beam": _number(event["value"])},
    "warning": lambda now, event: {"message": str(event["message"])},
    "snapshot": lambda now, event: {"views": int(event["n_views"]), "residual": _number(event.get("unlearnt"))},
    "scan_done": lambda now, event: {"time_left": 0.0, "rate": math.nan, "data_rate": math.nan},
}  # fmt: skip
