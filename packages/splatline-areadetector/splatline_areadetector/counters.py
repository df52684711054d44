"""Counters of the plugin and of the camera in the IOC. They show where frames were lost, and why no frame comes.

The module also finds the reason why frames cannot be stored. Each message says what to change."""

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
_LONG = 0.3  # s; if this process gets no processor time for longer, the server's queue may fill up
OURS = "this program"
_SETTLES = 0.2  # s until the camera's counter has arrived here
# a pause of the counter: number of periods, and least time in s; period of a slow camera in s
_REST, _LEAST, _SLOW = 5, 0.5, 10.0
_SKIPPED = "Nothing was recorded."
_PLUGINS = ("OVER", "ROI", "PROC", "TRANS", "CC", "STATS", "FFT", "CB", "CODEC", "SCATTER", "GATHER", "ATTR")
"""Usual beginnings of the port names of plugins; the output of a plugin may differ from the camera's frame."""
_SAFE = ("CB", "CODEC", "STATS", "ATTR")  # these plugins do not change pixels


@dataclass(frozen=True)
class Gap:
    """A gap in the numbers of the frames.

    Attributes:
        ids: numbers of the missing frames.
        before, after: IOC's times of the frames around the gap.
        still: time in s for which this process stalled during the gap.
    """

    ids: range
    before: float
    after: float
    still: float = 0.0


class Counters:
    """The counters of the PVA plugin and of the camera, as far as the IOC has them.

    Args:
        image: pva://PREFIX:Pva1:Image; the plugin's variables have the same prefix.
        camera: prefix of the camera's variables; None: they are not used.
    """

    def __init__(self, image: str, camera: str | None) -> None:
        with ExitStack() as opened:
            scheme, name = (camera or image).partition("://")[0], image.partition("://")[2]
            self.plugin = opened.enter_context(Variables(f"{scheme}://{name.rpartition(':')[0]}:", PLUGIN))
            self.camera = None if camera is None else opened.enter_context(Variables(camera, CAMERA, CAMERA[:1]))
            self.close = opened.pop_all().close

    def counted(self, first: float, second: float | None) -> int | None:
        """See `Witness`. The counter arrives slightly later than the frame that it counts. Only the increase of the
        counter is used, because the camera may have been in free run before."""
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
        """The cause of the loss of frames, as the end of a sentence."""
        margin = (gap.after - gap.before) / (len(gap.ids) + 1) / 2
        begin, end = gap.before + margin, gap.after + margin
        dropped = self.plugin.histories["DroppedArrays_RBV"].rise(begin, end)
        counted = self.plugin.histories["ArrayCounter_RBV"].rise(begin, end)
        if dropped:
            return (
                f"lost by the plugin {self.plugin.prefix}, whose queue was full (DroppedArrays rose by {dropped:.0f})"
            )
        if counted is None:
            return "lost before this program received these frames (no counter of the IOC shows where)"
        if counted > len(gap.ids):
            return (
                "lost between the plugin and this program: in the network, or in the server's queue for this "
                "program (ride.queue_s)"
            )
        return f"lost by the camera or its driver, before the plugin {self.plugin.prefix}"


def loss_sentences(gaps: Sequence[Gap], overflowed: Collection[int], counters: Counters) -> list[str]:
    """A sentence for each cause of lost frames.

    Args:
        overflowed: numbers of frames for which the receiver had no memory left.
    """
    causes: dict[str, list[int]] = {}
    for gap in gaps:
        for i in gap.ids:
            if i in overflowed:
                cause = (
                    f"lost by {OURS}: its memory for waiting frames was full, because the disk is too slow "
                    "(ride.ring_mb)"
                )
            elif gap.still > _LONG:
                cause = f"lost by {OURS}, which stalled for {gap.still:.1f} s (raise ride.queue_s to buffer longer)"
            else:
                cause = counters.blame(gap)
            causes.setdefault(cause, []).append(i)
    return [
        f"Frame{'s' * (len(ids) > 1)} {spans(ids)} {'were' if len(ids) > 1 else 'was'} {cause}."
        for cause, ids in causes.items()
    ]


class Silence:
    """Reports why no frame comes, each time that no frame has come for `seconds`.

    Args:
        say: prints the sentence.
        outcome: returns a sentence on what was recorded, for the error.
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
        """If no frame has come for `seconds`, report the reason. Raises InstrumentError if the server does not
        answer."""
        if self.lasted < self._seconds:
            return
        self.frame_came()
        if not self._stream.answers():
            raise InstrumentError(
                f"{self._stream.name}: no frame came for {self._seconds:g} s, and its server does not answer. "
                f"{self._outcome()}"
            )
        self._say(
            f"No frame came for {self._seconds:g} s, although the server answers: {silence_sentence(self._counters)}."
        )


def silence_sentence(counters: Counters) -> str:
    """The likely reason why no frames come, as far as the IOC shows it; the end of a sentence."""
    plugin, camera = counters.plugin, counters.camera
    if plugin.text("EnableCallbacks_RBV") == "Disable":
        return f"{plugin.prefix}EnableCallbacks is Disable; set it to Enable"
    if camera is None:
        return (
            "the camera waits for triggers, or does not acquire (set ride.camera, so that this message can say "
            "whether the camera acquires)"
        )
    if camera.text("ArrayCallbacks_RBV") == "Disable":
        return f"{camera.prefix}ArrayCallbacks is Disable; set it to Enable"
    state = camera.text("DetectorState_RBV")
    if camera.text("Acquire_RBV") in ("Done", "0.0"):
        return f"the camera does not acquire ({camera.prefix}Acquire is Done{f', {state}' if state else ''})"
    return "the camera waits for triggers"


def refuse_mistakes(config: RideConfig, counters: Counters, frame: ArrayFrame | None) -> None:
    """Raise ConfigError if the plugin skips frames, or if the frames are not those of the camera although the
    configuration does not request other frames.

    Args:
        frame: a frame of the stream; None: there is none yet.
    """
    plugin, seconds = counters.plugin.prefix, counters.plugin.number("MinCallbackTime_RBV")
    if seconds:
        raise ConfigError(
            f"Set {plugin}MinCallbackTime to 0: it is {seconds:g} s. If a frame comes sooner than this time after the "
            f"frame before, the plugin skips it and reports no error. {_SKIPPED}"
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
            f"{counters.plugin.prefix}NDArrayPort is {port}, but ride.source is {wanted}: set both to the same "
            f"port. {_SKIPPED}"
        )
    is_plugin = port.upper().startswith(_PLUGINS)
    if port.upper().startswith(_SAFE) or not (camera or is_plugin):
        return
    what = "overlays may be in the pixels" if port.upper().startswith("OVER") else "the plugin may change the pixels"
    raise ConfigError(
        f"{counters.plugin.prefix} sends the frames of {port}, not those of the "
        f"camera{f' {camera}' if camera else ''}: {what}. Set {counters.plugin.prefix}NDArrayPort to "
        f"{camera or 'the port of the camera'}, or, if you want the frames of {port}, set ride.source: {port}. "
        f"{_SKIPPED}"
    )


def _refuse_binned(config: RideConfig, frame: ArrayFrame, counters: Counters) -> None:
    down, across = frame.window.binning
    if down != across:
        raise ConfigError(
            f"Set the camera's BinX and BinY to the same value: pixels are binned {across} horizontally and {down} "
            f"vertically, and a volume needs square pixels. {_SKIPPED}"
        )
    camera = counters.camera
    by_camera = None if camera is None else camera.number("BinX_RBV")
    if across > 1 and by_camera != across and config.ride.source is None:
        who = "a plugin before" if camera is not None else "the camera or a plugin"
        raise ConfigError(
            f"Frames are binned {across} x {across} by {who} {config.ride.image}. Take unbinned frames (set "
            "NDArrayPort of the Pva plugin to a port before the binning), or, if you want binned frames, set "
            f"ride.source to the port of the binned frames. {_SKIPPED}"
        )
