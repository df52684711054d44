"""Counters: what the IOC's plugin and camera tell of a stream: whose loss a frame was, why none comes, and what makes
it unfit, each in a sentence that says what to change."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

from beamline.core.errors import ConfigError, InstrumentError
from beamline.core.text import spans
from splatline_areadetector.arrays import ArrayFrame
from splatline_areadetector.config import RideConfig
from splatline_areadetector.stream import FrameStream
from splatline_areadetector.variables import Variables

PLUGIN = ("NDArrayPort_RBV", "EnableCallbacks_RBV", "MinCallbackTime_RBV", "DroppedArrays_RBV", "ArrayCounter_RBV",
          "QueueFree")  # fmt: skip
CAMERA = ("PortName_RBV", "Acquire_RBV", "DetectorState_RBV", "ArrayCallbacks_RBV", "NumImagesCounter_RBV",
          "ArrayCounter_RBV", "AcquireTime_RBV", "AcquirePeriod_RBV", "BinX_RBV", "BinY_RBV")  # fmt: skip
_LONG = 0.3  # s without the processor that may fill the server's queue
OURS = "this program"
_SETTLES = 0.2  # s in which the camera's counter comes here
_REST, _LEAST, _SLOW = 5, 0.5, 10.0  # periods, s without a count that are a pause; s, of a camera that is slow
_SKIPPED = "Nothing was recorded."
_PLUGINS = ("OVER", "ROI", "PROC", "TRANS", "CC", "STATS", "FFT", "CB", "CODEC", "SCATTER", "GATHER", "ATTR")
"""Beginnings of the usual port names of plugins: what they give out may be no camera's frame."""
_SAFE = ("CB", "CODEC", "STATS", "ATTR")  # pixels pass through these as they are


@dataclass(frozen=True)
class Gap:
    """Numbers that did not come.

    Attributes:
        ids: of the frames.
        before, after: IOC's times of the frames around it.
        still: s in which this process stood still meanwhile.
    """

    ids: range
    before: float
    after: float
    still: float = 0.0


class Counters:
    """The counters of the PVA plugin and of the camera, as far as the IOC has them.

    Args:
        image: pva://PREFIX:Pva1:Image, whose prefix the plugin's variables have.
        camera: prefix of the camera's; None: it is not asked.
    """

    def __init__(self, image: str, camera: str | None) -> None:
        with ExitStack() as opened:
            scheme, name = (camera or image).partition("://")[0], image.partition("://")[2]
            self.plugin = opened.enter_context(Variables(f"{scheme}://{name.rpartition(':')[0]}:", PLUGIN))
            self.camera = None if camera is None else opened.enter_context(Variables(camera, CAMERA, CAMERA[:1]))
            self.close = opened.pop_all().close

    def counted(self, first: float, second: float | None) -> int | None:
        """See `Witness`. The counter comes here somewhat after the frame that it counts. Only its rise says something:
        a camera may have run free before."""
        if self.camera is None:
            return None
        time.sleep(_SETTLES)
        period = _SLOW if second is None else second - first
        rise = self.camera.histories["NumImagesCounter_RBV"].risen(first + 0.7 * period, max(_REST * period, _LEAST))
        return None if rise is None else int(rise)

    def were_lost(self, begin: float, end: float, n: int) -> bool:
        """See `Witness`."""
        rises = [
            self.plugin.histories[name].rise(begin, end) or 0.0 for name in ("DroppedArrays_RBV", "ArrayCounter_RBV")
        ]
        return rises[0] > 0 or rises[1] > n

    def blame(self, gap: Gap) -> str:
        """Whose loss it was, as a sentence's end."""
        margin = (gap.after - gap.before) / (len(gap.ids) + 1) / 2
        begin, end = gap.before + margin, gap.after + margin
        dropped = self.plugin.histories["DroppedArrays_RBV"].rise(begin, end)
        counted = self.plugin.histories["ArrayCounter_RBV"].rise(begin, end)
        if dropped:
            return f"by the plugin {self.plugin.prefix}, whose queue was full (DroppedArrays rose by {dropped:.0f})"
        if counted is None:
            return "before they arrived here; no counter of the IOC shows where"
        if counted > len(gap.ids):
            return (
                "between the plugin, which sent them, and this computer: in the network, or in the queue of the server"
            )
        return f"before the plugin {self.plugin.prefix}: by the camera or its driver"


def losses_told(gaps: Sequence[Gap], overflowed: Collection[int], counters: Counters) -> list[str]:
    """A sentence for each cause of lost frames.

    Args:
        overflowed: numbers of frames for which the receiver had no room.
    """
    causes: dict[str, list[int]] = {}
    for gap in gaps:
        for i in gap.ids:
            if i in overflowed:
                cause = (
                    f"by {OURS}, because its memory for waiting frames was full: the disk is too slow (ride.ring_mb)"
                )
            elif gap.still > _LONG:
                cause = f"by {OURS}, which stood still for {gap.still:.1f} s (ride.queue_s)"
            else:
                cause = counters.blame(gap)
            causes.setdefault(cause, []).append(i)
    return [
        f"Frame{'s' * (len(ids) > 1)} {spans(ids)} {'were' if len(ids) > 1 else 'was'} lost {cause}."
        for cause, ids in causes.items()
    ]


class Silence:
    """Says why no frame comes, each time that none has come for so many s.

    Args:
        say: takes the sentence.
        outcome: what was recorded, as a sentence, for the error.
    """

    def __init__(
        self, stream: FrameStream, counters: Counters, seconds: float, say: Callable[[str], None],
        outcome: Callable[[], str],
    ) -> None:  # fmt: skip
        self._stream, self._counters, self._seconds = stream, counters, seconds
        self._say, self._outcome = say, outcome
        self.frame_came()

    def frame_came(self) -> None:
        self._since = time.monotonic()

    @property
    def lasted(self) -> float:
        """s since the last frame."""
        return time.monotonic() - self._since

    def look(self) -> None:
        """Say why, where no frame has come for `seconds`. InstrumentError: the server does not answer."""
        if self.lasted < self._seconds:
            return
        self.frame_came()
        silent = f"o frame for {self._seconds:g} s"
        if not self._stream.answers():
            raise InstrumentError(f"{self._stream.name}: n{silent}, and its server does not answer. {self._outcome()}")
        self._say(f"N{silent}, the server answers: {silence_told(self._counters)}.")


def silence_told(counters: Counters) -> str:
    """Why no frames may come, as far as the IOC tells, as a sentence's end."""
    plugin, camera = counters.plugin, counters.camera
    if plugin.text("EnableCallbacks_RBV") == "Disable":
        return f"{plugin.prefix}EnableCallbacks is Disable; set it to Enable"
    if camera is None:
        return "the camera waits for triggers, or does not acquire (ride.camera would tell)"
    if camera.text("ArrayCallbacks_RBV") == "Disable":
        return f"{camera.prefix}ArrayCallbacks is Disable; set it to Enable"
    state = camera.text("DetectorState_RBV")
    if camera.text("Acquire_RBV") in ("Done", "0.0"):
        return f"the camera does not acquire ({camera.prefix}Acquire is Done{f', {state}' if state else ''})"
    return "the camera waits for triggers"


def refuse_mistakes(config: RideConfig, counters: Counters, frame: ArrayFrame | None) -> None:
    """Raise ConfigError if frames are skipped, or are not the camera's own and the configuration does not want them.

    Args:
        frame: of the stream; None: it has none yet.
    """
    plugin, seconds = counters.plugin.prefix, counters.plugin.number("MinCallbackTime_RBV")
    if seconds:
        raise ConfigError(
            f"{plugin}MinCallbackTime is {seconds:g} s: frames that come sooner are skipped, and no error is reported. "
            f"Set it to 0. {_SKIPPED}"
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
    is_plugin = port.upper().startswith(_PLUGINS)
    if port.upper().startswith(_SAFE) or not (camera or is_plugin):
        return
    what = "overlays may be in the pixels" if port.upper().startswith("OVER") else "pixels may be others"
    raise ConfigError(
        f"{counters.plugin.prefix} shows {port}, not the camera{f' {camera}' if camera else ''}: {what}. Set "
        f"{counters.plugin.prefix}NDArrayPort to {camera or 'its port'}, or ride.source: {port}. {_SKIPPED}"
    )


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
