"""The labels of a simulated scan, read back."""

import json
from pathlib import Path

from beamline.simulate import LabelledRun


def read_labels(path: Path) -> tuple[LabelledRun, ...]:
    """The labels of a file from `write_labels`."""
    content = json.loads(path.read_text(encoding="utf-8"))
    return tuple(
        LabelledRun(entry["kind"], entry["first_frame"], tuple(tuple(region) for region in entry["regions"]))
        for entry in content["anomalies"]
    )
