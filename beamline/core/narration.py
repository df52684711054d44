"""Narration: events as sentences for people."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, TextIO

from beamline.core.events import Event
from beamline.core.text import size, spans


def sentence(event: Event) -> str | None:
    """The event as a sentence; None for events that only update a progress display."""
    data = event.data
    match event.event:
        case "run_started":
            size_text = size(data["total_bytes"])
            return f"Run {data['folder']}: {data['n_frames']} frames, {size_text}, {data['duration']:.0f} s"
        case "state" | "warning":
            text = str(data["message"])
            return f"Warning: {text}" if event.event == "warning" else text or None
        case "block_started":
            return f"{data['n']} {data['kind']} frames ({data['mode']}, {data['exposure']:g} s each)"
        case "block_done":
            return _missing(data)
        case "flag":
            return f"{str(data['level']).capitalize()} ({data['check']}, frame {data['frame']}): {data['advice']}"
        case "recon_started":
            again = " again, from the start" if data.get("again") else ""
            axis = f"rotation axis at column {data['axis_col']:.2f}"
            return f"{data['method']}{again}: {data['n_views']} views, {axis}"
        case "tradeoff_started":
            return f"{data['trials']} trials of {data['file']}, quality by {data['by']}"
        case "study_started":
            return f"{data['study']}: {data['rows']} reconstructions of {data['file']}"
        case "trial":
            return _trial(data)
        case "snapshot":
            return f"Volume from {data['n_views']} views so far: {data['path']}"
        case "enough":
            spread = f"{data['mean']:.2f} dB ({data['low']:.2f} to {data['high']:.2f})"
            return f"Enough views: {data['n_views']} of {data['planned']}; the others would add {spread}"
        case "scan_done":
            alarms = f", {data['alarmed_frames']} WITH AN ALARM" if data.get("alarmed_frames") else ""
            again = f", {data['retaken']} views taken again" if data.get("retaken") else ""
            return (
                f"Scan {data['status']}: {data['n_frames']} frames{again}{alarms}, {size(data['bytes'])}, "
                f"{data['seconds']:.1f} s: {data['path']}"
            )
        case "recon_done":
            return f"Volume: {data.get('output', '')}"
        case "failed":
            return f"Failed: {data['message']}"
        case "done":
            return f"Done: {data['folder']}"
    return None


class UserLog:
    """A sink that writes each event's sentence with its UTC time."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __call__(self, event: Event) -> None:
        text = sentence(event)
        if text:
            stamp = datetime.fromtimestamp(event.time, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
            self._stream.write(f"{stamp}  {text}\n")
            self._stream.flush()


def _trial(data: Mapping[str, Any]) -> str:
    begin = f"{data['n']}/{data['of']} {data['label']}: "
    if data["status"] != "done":
        return begin + f"{data['status']}: {data['message']}"
    quality = f", {data['quality_db']:.2f} dB" if math.isfinite(data["quality_db"]) else ""
    memory = "" if data["peak_bytes"] is None else f", {size(data['peak_bytes'])}"
    return begin + f"{data['seconds']:.2f} s{quality}{memory}"


def _missing(data: Mapping[str, Any]) -> str | None:
    parts = [f"{len(data['missing'])} missing ({spans(data['missing'])})"] if data["missing"] else []
    parts += [f"{data['extra']} without a trigger"] if data["extra"] else []
    return f"Of {data['n']} {data['kind']} frames: {', '.join(parts)}" if parts else None
