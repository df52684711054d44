"""What a reconstruction came to, for people: where the volume is, then its figures of merit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from beamline.report.metrics import METRICS, formatted


def results(data: Mapping[str, Any]) -> str:
    """What came out, as lines of text: where it is, then the metrics by method."""
    lines = [f"{'output':<10}{data['output']}"]
    if data.get("report"):
        lines.append(f"{'report':<10}{data['report']}")
    lines.append(f"{'volume':<10}{' x '.join(str(n) for n in data['shape'])} in {data['units']}")
    lines.append(f"{'axis_col':<10}{data['axis_col']:.2f}")
    for name, key in (("chosen", "chosen"), ("next dB", "next_db_said")):
        if key in data:
            lines.append(f"{name:<10}{data[key]}")
    columns = {str(data["method"]): data}
    if "fbp" in data:
        columns["fbp"] = data["fbp"]
    lines.append("")
    lines.append(f"{'':<30}" + "".join(f"{name:>14}" for name in columns))
    for name, metric in METRICS.items():
        if any(name in values for values in columns.values()):
            cells = (formatted(name, values[name]) if name in values else "-" for values in columns.values())
            label = metric.label
            if name == "seconds" and "resumed_from" in data:
                label += ", since resumed"
            lines.append(f"{label:<30}" + "".join(f"{cell:>14}" for cell in cells))
    return "\n".join(lines)
