"""Copies of the shipped configurations, each with a wrong line."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import cycle, islice, product
from pathlib import Path

from beamline.config.load import config_folder

EDITS = (
    ("name: battery ", "name: bat/tery ", "sample.name is 'bat/tery'; expected text of letters"),
    ("mode: fly ", "mode: flyy ", "scan.mode is 'flyy' (did you mean fly?); expected fly | step"),
    ("exposure_s: 0.05\n", "exposure_s: fast\n", "scan.exposure_s is 'fast'; expected a number"),
    ("period_s: 0.1 ", "period_s: -0.1 ", "scan.period_s is -0.1; expected a number > 0"),
    ("period_s: 0.1 ", "period_s: 0.04 ", "scan.period_s 0.04 is below the camera's minimum"),  # a limit of the plan
    ("darks: {count: ", "darks: {count: -", "scan.darks.count is -"),
    ("settle_s: 0.1 ", "setle_s: 0.1 ", "scan.setle_s is not a known key (did you mean settle_s?)"),
    ("counts_per_turn: 360000 ", "counts_per_turn: many ", "devices.stage.counts_per_turn is 'many'; expected"),
    ("binning: 1 ", "binning: 3 ", "devices.camera.binning is 3; expected 1 | 2 | 4"),
    ("energy_kev: 25.0 ", "energy_kev: 25000 ", "optics.energy_kev = 25000 keV is outside the usual range"),
    ("axis_col: null ", "axis_col: 9000 ", "optics.axis_col 9000 is outside the columns of the frame"),  # a limit
    (
        "distance_mm: 100.0 ",
        "distance_mm:100.0 ",
        "this is not YAML (a space is missing after the colon of the line above",
    ),
    ("preview_bin: ", "preview_bin: -", "storage.preview_bin is -"),
    ("flush_every: 16 ", "flush_every: [ ", "this is not YAML (the [ of this line is never closed)"),
    ("act_after: 10 ", "act_after: 10\n  act_after: 3 ", "monitor.act_after appears twice"),
    ("method: r2 ", "method: r3 ", "recon.method is 'r3'"),
)
"""What is written in place of what, and how the fault begins."""


@dataclass(frozen=True)
class WrongConfig:
    """A configuration with a wrong line, and how the fault of this line begins."""

    path: Path
    line: int
    sentence: str


def wrong_configs(folder: Path, n: int) -> list[WrongConfig]:
    """Write n of them; after every copy of each edit they begin again, with other samples."""
    made = []
    for number, (name, (old, new, sentence)) in enumerate(
        islice(cycle(product(("simulated", "instrument"), EDITS)), n)
    ):
        text = (config_folder() / f"{name}.yaml").read_text("utf-8")
        assert text.count(old) >= 1, (name, old)
        before, _, after = text.partition(old)
        path = folder / f"scan_{number}.yaml"
        path.write_text(before + new + after, "utf-8")
        line = (before + new).rstrip("\n").count("\n") + 1 + ("line above" in sentence)
        made.append(WrongConfig(path, line, sentence))
    return made
