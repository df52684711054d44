"""`beamline ride --check`: shows the settings of the IOC, and whether the frames of two seconds arrive without gaps."""

from __future__ import annotations

from contextlib import ExitStack

from beamline.core.text import size, spans
from drivers.base.clock import SystemClock
from splatline_areadetector.arrays import ArrayFrame
from splatline_areadetector.config import RideConfig
from splatline_areadetector.counters import Counters, silence_sentence
from splatline_areadetector.ride import opened
from splatline_areadetector.stream import FrameStream, Refused

SECONDS = 2.0


def check(config: RideConfig) -> list[str]:
    """Lines about the image of a configuration. Raises the ConfigError or DeviceError that `beamline ride` would
    raise."""
    with ExitStack() as held:
        stream, guide, counters = opened(config, held)
        frames, refused = _taken(stream)
        rows = {
            "image": stream.name,
            "frames": _size(frames[-1] if frames else stream.first),
            "port": counters.plugin.text("NDArrayPort_RBV")
            or "not known, because the IOC does not answer for the plugin's process variables",
            "queue": f"{stream.queue} frames in the server",
            "arrival": _arrival(frames) or f"no frame in {SECONDS:g} s: {silence_sentence(counters)}",
            "refused": refused,
            "dropped": _dropped(counters),
            "attributes": ", ".join(frames[-1].attributes) if frames else "",
            "scan": guide.status,
        }
    return [f"{name:<12}{text}" for name, text in rows.items() if text]


def _taken(stream: FrameStream) -> tuple[list[ArrayFrame], str]:
    clock, frames = SystemClock(), list[ArrayFrame]()
    end = clock.now() + SECONDS
    while (remaining := end - clock.now()) > 0:
        item = stream.next(remaining)
        if isinstance(item, Refused):
            return frames, item.why
        if isinstance(item, ArrayFrame) and not item.is_current:
            frames.append(item)
    return frames, ""


def _size(frame: ArrayFrame | None) -> str:
    if frame is None:
        return "none yet"
    window, codec = frame.window, f", {frame.codec}" if frame.codec else ""
    binned = f", binned {window.binning[0]} x {window.binning[1]}" if window.binning != (1, 1) else ""
    window_words = f", from row {window.offset[0]}, column {window.offset[1]}" if window.offset != (0, 0) else ""
    return f"{window.shape[0]} x {window.shape[1]} {frame.dtype}{codec}{binned}{window_words}"


def _arrival(frames: list[ArrayFrame]) -> str:
    if len(frames) < 2:
        return f"1 frame in {SECONDS:g} s" if frames else ""
    ids = [frame.unique_id for frame in frames]
    seconds = frames[-1].received - frames[0].received
    rate = (len(frames) - 1) / seconds if seconds > 0 else 0.0
    missing = sorted({*range(ids[0], ids[-1] + 1)} - {*ids})
    whole = f"numbers {spans(missing)} are missing" if missing else "none missing"
    again = f", {len(ids) - len({*ids})} arrived twice" if len({*ids}) < len(ids) else ""
    return (
        f"{rate:.1f} frames/s, {size(int(rate * frames[-1].n_bytes))}/s, numbers {ids[0]} to {ids[-1]}: {whole}{again}"
    )


def _dropped(counters: Counters) -> str:
    dropped = counters.plugin.number("DroppedArrays_RBV")
    return "" if dropped is None else f"{dropped:.0f} arrays dropped by the plugin since DroppedArrays was reset"
