"""Doctor on memory: is there room for the camera's ring and for the frames that wait for the disk?"""

from __future__ import annotations

from beamline.core.text import size
from beamline.doctor.check import Check, Verdict
from beamline.doctor.needs import Needs

MEMORY = "memory"


def memory(free: int | None, needs: Needs | None) -> Check:
    """Free memory against a scan's need.

    Args:
        free: bytes; None where the system does not tell.
    """
    expected, values = "", {"free_bytes": free}
    if needs is not None:
        parts = [f"{size(needs.waiting_bytes)} for frames that wait for the disk"]
        if needs.ring_bytes:
            parts.append(f"{size(needs.ring_bytes)} for the camera's ring")
        expected = " and ".join(parts) + ", besides the live reconstruction"
        values |= {"needed_bytes": needs.memory, "ring_bytes": needs.ring_bytes}
    if free is None:
        return Check(MEMORY, Verdict.CANNOT_CHECK, "This system does not tell its free memory.", expected)
    found = f"{size(free)} free."
    if needs is None or free >= 2 * needs.memory:
        return Check(MEMORY, Verdict.OK, found, expected, values=values)
    advice = "Close other programs, or choose a smaller roi or binning"
    return Check(MEMORY, Verdict.WARNING if free >= needs.memory else Verdict.FAILED, found, expected, advice, values)
