"""The module that pyserial looks for to open `sim://` URLs; see `simulators.serial_url`."""

from __future__ import annotations

from simulators.serial_url import SimulatedSerial as Serial

__all__ = ["Serial"]
