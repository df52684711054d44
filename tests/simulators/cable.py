"""What has come out of a trigger cable by now."""

from __future__ import annotations

import math

from drivers.clock import Clock
from simulators.devices.trigger_line import Pulse, TriggerLine


def emitted(line: TriggerLine, clock: Clock) -> list[Pulse]:
    """The pulses up to now, in their order."""
    found: list[Pulse] = []
    after = -math.inf
    while (pulse := line.next_after(after)) is not None and pulse.time <= clock.now():
        found.append(pulse)
        after = pulse.time
    return found
