"""Explained: the cost of a scene's frame as a table for people."""

from __future__ import annotations

from collections.abc import Callable

from beamline.core.text import size
from simulators.scenes.explain import Explained, explain
from simulators.scenes.shots import Scan


def explained(scan: Scan, now: Callable[[], float]) -> Explained:
    """The cost of a view in the middle of the scan, where whatever happens during a scan is likeliest to happen."""
    return explain(scan.scene, scan.frame(len(scan) - 1 - scan.views // 2).shot, now)


def table(found: Explained) -> str:
    """A line a step, in order, and the effects that are not called for."""
    lines = [f"{'step':<22}{'acts on':<15}{'ms/frame':>9}{'memory':>10}  what happens"]
    for cost in found.costs:
        domain = "" if cost.domain is None else cost.domain.words
        lines.append(f"{cost.name:<22}{domain:<15}{cost.ms:>9.2f}{size(cost.size):>10}  {cost.says}")
    lines.append(f"{'a frame':<37}{found.ms:>9.2f}")
    lines.append("\nNot called for, not imported, not paid for:")
    lines += [f"  {name:<20}{says}" for name, says in found.not_called_for]
    return "\n".join(lines)
