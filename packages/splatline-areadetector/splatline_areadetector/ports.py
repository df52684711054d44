"""Ports: what makes a stream of areaDetector unfit for a scan, each in a sentence that says what to change."""

from __future__ import annotations

from beamline.core.errors import ConfigError
from splatline_areadetector.arrays import ArrayFrame
from splatline_areadetector.config import RideConfig
from splatline_areadetector.losses import Counters

_SKIPPED = "Nothing was recorded."
_PLUGINS = ("OVER", "ROI", "PROC", "TRANS", "CC", "STATS", "FFT", "CB", "CODEC", "SCATTER", "GATHER", "ATTR")
"""Beginnings of the usual port names of plugins: what they give out may be no camera's frame."""
_SAFE = ("CB", "CODEC", "STATS", "ATTR")  # pixels pass through these as they are


def refuse_mistakes(config: RideConfig, counters: Counters, frame: ArrayFrame | None) -> None:
    """Raise ConfigError if frames are skipped, or are not the camera's own and the configuration does not want them.

    Args:
        frame: of the stream; None: it has none yet.
    """
    plugin, seconds = counters.plugin.prefix, counters.plugin.number("MinCallbackTime_RBV")
    if seconds:
        raise ConfigError(
            f"{plugin}MinCallbackTime is {seconds:g} s: frames that come sooner are skipped without a word. Set it to "
            f"0. {_SKIPPED}"
        )
    _refuse_port(config.ride.source, counters)
    if frame is not None:
        _refuse_binned(config, frame, counters)


def _refuse_port(wanted: str | None, counters: Counters) -> None:
    port = counters.plugin.text("NDArrayPort_RBV")
    camera = "" if counters.camera is None else counters.camera.text("PortName_RBV")
    if not port or port == (wanted or camera):
        return
    if wanted is not None:
        raise ConfigError(
            f"{counters.plugin.prefix}NDArrayPort is {port}, and ride.source {wanted}: set one of them. {_SKIPPED}"
        )
    if not camera and not _is_plugin(port):
        return
    if _is_plugin(port, _SAFE):
        return
    what = "overlays may be in the pixels" if port.upper().startswith("OVER") else "pixels may be others"
    raise ConfigError(
        f"{counters.plugin.prefix} shows {port}, not the camera{f' {camera}' if camera else ''}: {what}. Set "
        f"{counters.plugin.prefix}NDArrayPort to {camera or 'its port'}, or ride.source: {port}. {_SKIPPED}"
    )


def _is_plugin(port: str, names: tuple[str, ...] = _PLUGINS) -> bool:
    return port.upper().startswith(names)


def _refuse_binned(config: RideConfig, frame: ArrayFrame, counters: Counters) -> None:
    down, across = frame.window.binning
    if down != across:
        raise ConfigError(
            f"Pixels are binned {across} across and {down} down: a volume needs square ones. Set the camera's BinX and "
            f"BinY alike. {_SKIPPED}"
        )
    camera = counters.camera
    by_camera = None if camera is None else camera.number("BinX_RBV")
    if across > 1 and by_camera != across and config.ride.source is None:
        who = "a plugin before" if camera is not None else "the camera or a plugin"
        raise ConfigError(
            f"Frames are binned {across} x {across} by {who} {config.ride.image}: take them before it "
            f"(NDArrayPort of the Pva plugin), or, if they are meant, set ride.source to that port. {_SKIPPED}"
        )
