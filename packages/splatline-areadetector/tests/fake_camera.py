"""A fake camera behind areaDetector, as a program: records by Channel Access and PVAccess, its image by PVAccess.

fake_camera.py PREFIX DRIVER. Lines of stdin are times (s since 1970) of pulses on its trigger input, or "size ROWS
COLS", which makes its next frames that large, as a plugin before the image does.
"""

from __future__ import annotations

import math
import random
import sys
import threading
import time
from dataclasses import dataclass, field

import numpy as np

from drivers.base.frame import FrameKind
from splatline_areadetector.publish_detector import Record, Sides, Value
from splatline_areadetector.publish_frames import PublishedFrame
from splatline_areadetector.publish_servers import ImageServer, RecordServer

SENSOR, READOUT, DEAD = (256, 320), 0.003, 0.002  # pixels, s, s
LATEST = 0.003  # s after readout by which the driver has a frame
MODES = {
    "spinnaker": ("Off", "On"),
    "andor3": ("Internal", "Software", "External", "External Start", "External Exposure", "Advanced"),
    "simdetector": ("Internal", "External"),
}
IMAGE_MODES = {"andor3": ("Fixed", "Continuous")}
SOURCES = ("Software", "Line0", "Line1", "Line2")


def records(driver: str) -> list[Record]:
    rows, cols = SENSOR
    return [
        *(Record(f"cam1:{name}", "fake", sides=Sides.READBACK) for name in ("Model", "Manufacturer")),
        *(Record(f"cam1:{name}", n, sides=Sides.READBACK) for name, n in (("MaxSizeX", cols), ("MaxSizeY", rows))),
        Record("cam1:Acquire", 0, ("Done", "Acquire")),
        Record("cam1:AcquireTime", 0.01),
        Record("cam1:AcquirePeriod", 0.02),
        Record("cam1:NumImages", 1),
        Record("cam1:ArrayCounter", 0),
        Record("cam1:ImageMode", 0, IMAGE_MODES.get(driver, ("Single", "Multiple", "Continuous"))),
        Record("cam1:TriggerMode", 0, MODES[driver]),
        Record("cam1:TriggerSource", 0, SOURCES),
        Record("cam1:TriggerOverlap", 0, ("Off", "ReadOut", "PreviousFrame")),
        Record("cam1:ExposureMode", 0, ("Timed", "TriggerWidth", "Off")),
        Record("cam1:FrameRateEnable", 1, ("No", "Yes")),
        Record("cam1:TriggerSoftware", 0, ("Done", "Trigger"), Sides.SETPOINT),
        Record("cam1:SoftwareTrigger", 0, ("Done", "Trigger"), Sides.SETPOINT),
        Record("cam1:A3Binning", 0, ("1x1", "2x2", "4x4")),
        *(Record(f"cam1:{name}", 1) for name in ("BinX", "BinY")),
        *(Record(f"cam1:{name}", n) for name, n in (("MinX", 0), ("MinY", 0), ("SizeX", cols), ("SizeY", rows))),
    ]  # fmt: skip


@dataclass
class FakeCamera:
    """Its state; `lock` is held while it changes."""

    driver: str
    lock: threading.RLock = field(default_factory=threading.RLock)
    values: dict[str, float | str] = field(default_factory=dict)
    pulses: list[float] = field(default_factory=list)
    exposed: list[float] = field(default_factory=list)  # times of triggers whose frames are still to come
    begun: float = math.inf  # when it was told to acquire
    last: float = -math.inf  # accepted trigger
    frames: int = 0  # of this acquisition
    counter: int = 0
    size: tuple[int, int] | None = None

    def serve(self, prefix: str) -> None:
        named = {record.name: record for record in records(self.driver)}
        self.values = {n: r.labels[int(r.initial)] if r.labels else r.initial for n, r in named.items()}

        def asked(name: str, value: Value) -> None:
            with self.lock:
                record = named[name]
                self.values[name] = record.labels[int(value)] if record.labels else value
                if name == "cam1:ArrayCounter":
                    self.counter = int(value)
                if name in ("cam1:TriggerSoftware", "cam1:SoftwareTrigger") and value:
                    self.exposed.append(time.time())
                if name == "cam1:Acquire":
                    self.begun, self.last, self.frames = (time.time() if value else math.inf), -math.inf, 0
                    self.exposed.clear()
                if record.sides is Sides.BOTH:
                    server.put(f"{name}_RBV", value)

        image = ImageServer(f"{prefix}Pva1:Image", "127.0.0.1", 0)
        server = RecordServer(prefix, list(named.values()), "127.0.0.1", asked)
        threading.Thread(target=self.read_pulses, daemon=True).start()
        print("ready", flush=True)
        rng = random.Random(1)
        while True:
            time.sleep(0.001)
            with self.lock:
                if self.begun < math.inf:
                    self.trigger(time.time())
                ready = [at for at in self.exposed if at + self.exposure + READOUT <= time.time()]
                for at in ready:
                    self.exposed.remove(at)
                    self.frames += 1
                    self.counter += 1
                    server.put("cam1:ArrayCounter_RBV", self.counter)
                    number = self.counter if self.driver != "spinnaker" else self.frames - 1
                    rows, cols = self.size or self.shape
                    counts = np.full((rows, cols), self.frames, np.uint16)
                    stamp = at + self.exposure + READOUT + rng.uniform(0, LATEST)
                    image.post(PublishedFrame(counts, number, FrameKind.PROJECTION, 0.0, stamp, self.exposure))
                    if self.values["cam1:ImageMode"] == "Single":
                        self.begun = math.inf
                        server.put("cam1:Acquire", 0)
                        server.put("cam1:Acquire_RBV", 0)

    @property
    def exposure(self) -> float:
        return float(self.values["cam1:AcquireTime"])

    @property
    def shape(self) -> tuple[int, int]:
        rows, cols = int(self.values["cam1:SizeY"]), int(self.values["cam1:SizeX"])
        binning = 1 if self.driver == "spinnaker" else int(self.values["cam1:BinX"])
        binning *= int(str(self.values["cam1:A3Binning"])[0])
        return rows // binning, cols // binning

    def trigger(self, now: float) -> None:
        """Expose for what has come by now."""
        mode, period = self.values["cam1:TriggerMode"], self.exposure + DEAD
        if mode in ("Off", "Internal"):
            wanted = 1 if self.values["cam1:ImageMode"] == "Single" else int(self.values["cam1:NumImages"])
            due, done = min(int((now - self.begun) / period) + 1, wanted), self.frames + len(self.exposed)
            self.exposed += [self.begun + k * period for k in range(done, due)]
            return
        if mode == "Software" or (mode == "On" and self.values["cam1:TriggerSource"] == "Software"):
            return
        come = sorted(at for at in self.pulses if self.begun <= at <= now)
        self.pulses = [at for at in self.pulses if at > now]
        for at in come:
            if at - self.last >= period * (1 - 1e-6):
                self.last = at
                self.exposed.append(at)

    def read_pulses(self) -> None:
        for line in sys.stdin:
            words = line.split()
            with self.lock:
                if words and words[0] == "size":
                    self.size = (int(words[1]), int(words[2])) if len(words) == 3 else None
                else:
                    self.pulses += [float(word) for word in words]


if __name__ == "__main__":
    FakeCamera(sys.argv[2]).serve(sys.argv[1])
