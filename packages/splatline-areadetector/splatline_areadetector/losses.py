"""Losses: whose loss a frame was that did not come, as far as the counters of plugin and camera tell."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

from beamline.core.text import spans
from splatline_areadetector.variables import Variables

PLUGIN = ("NDArrayPort_RBV", "EnableCallbacks_RBV", "MinCallbackTime_RBV", "DroppedArrays_RBV", "ArrayCounter_RBV",
          "QueueFree")  # fmt: skip
CAMERA = ("PortName_RBV", "Acquire_RBV", "DetectorState_RBV", "ArrayCallbacks_RBV", "NumImagesCounter_RBV",
          "ArrayCounter_RBV", "AcquireTime_RBV", "AcquirePeriod_RBV", "BinX_RBV", "BinY_RBV")  # fmt: skip
_LONG = 0.3  # s without the processor that may fill the server's queue
OURS = "this program"


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

    def blame(self, gap: Gap) -> str:
        """Whose loss it was, as a sentence's end."""
        margin = (gap.after - gap.before) / (len(gap.ids) + 1) / 2
        begin, end = gap.before + margin, gap.after + margin
        dropped = self.plugin.histories["DroppedArrays_RBV"].rise(begin, end)
        counted = self.plugin.histories["ArrayCounter_RBV"].rise(begin, end)
        if dropped:
            return f"by the plugin {self.plugin.prefix}, whose queue was full (DroppedArrays rose by {dropped:.0f})"
        if counted is None:
            return "before they came here: no counter of the IOC tells where"
        if counted > len(gap.ids):
            return "between the plugin, which sent them, and here: the network, or the server's queue for us"
        return f"before the plugin {self.plugin.prefix}: by the camera or its driver"


def losses_told(gaps: Sequence[Gap], overflowed: Collection[int], counters: Counters) -> list[str]:
    """A sentence for each cause of lost frames.

    Args:
        overflowed: numbers for which the ring had no room.
    """
    causes: dict[str, list[int]] = {}

    def add(cause: str, ids: Iterable[int]) -> None:
        causes.setdefault(cause, []).extend(ids)

    for gap in gaps:
        ours = [i for i in gap.ids if i in overflowed]
        if ours:
            add(f"by {OURS}, whose ring was full: the disk is too slow (ride.ring_mb)", ours)
        if others := [i for i in gap.ids if i not in overflowed]:
            if gap.still > _LONG:
                add(f"by {OURS}, which stood still for {gap.still:.1f} s (ride.queue_s)", others)
            else:
                add(counters.blame(gap), others)
    return [f"Frames {spans(ids)} were lost {cause}." for cause, ids in causes.items()]
