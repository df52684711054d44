"""The module that pyserial looks for to open `sim://` URLs; see `simulators.wires.serial_url`."""

from __future__ import annotations

from simulators.wires.serial_url import SimulatedSerial as Serial

__all__ = ["Serial"]
