"""The module that pyserial looks for to open `sim://` URLs; see `simulators.wires.wire`."""

from __future__ import annotations

from simulators.wires.wire import SimulatedSerial as Serial

__all__ = ["Serial"]
