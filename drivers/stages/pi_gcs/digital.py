"""A digital output of a PI controller that talks GCS 2.0, set by DIO, for a shutter on the stage's controller."""

from __future__ import annotations

from drivers.stages.pi_gcs.line import GcsLine


class GcsOutput:
    """Implements `drivers.shutter.DigitalOutput` on the line of a stage that is open.

    `DIO?` tells the inputs [from memory: of GCS controllers in general], so that an output cannot be read back.
    """

    def __init__(self, line: GcsLine, number: int, name: str) -> None:
        self.name = name
        self._line, self._number = line, number

    def set(self, high: bool) -> None:
        self._line.set(f"DIO {self._number} {int(high)}")

    def get(self) -> None:
        return None
