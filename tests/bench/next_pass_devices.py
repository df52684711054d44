"""The scenes of next_pass as complete scans with simulated devices and a virtual clock, which decide themselves.

python -m tests.bench.next_pass_devices FOLDER --scenes 0,2,4,5 runs `beamline scan` with `scan.decide: do` in FOLDER,
and prints from its file: decisions, frames, and the real time in s from the last frame of a pass to the decision.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import yaml

from beamline.config.load import Config, load, override_of
from beamline.core.errors import ScanStopped
from beamline.core.events import Event, ScanDone
from beamline.core.sinks import sentence
from beamline.core.stop import StopRequest
from beamline.plan.passes import Choice, Passes
from beamline.scan.decider import Decider
from beamline.scan.live_process import commands_of
from beamline.scan.run import run_scan
from beamline.storage.readers.open import open_scan
from tests.bench.next_pass_scenes import (
    COLS,
    CRUMB_DEPTH,
    CRUMB_SIZE,
    CRUMBED,
    OPTICS,
    PASSES,
    PITCH,
    RECIPES,
    ROWS,
    VIEWS,
    WIDE_ANGLES,
    mapping_of,
)

SHIPPED = Path(__file__).parents[2] / "configs" / "simulated.yaml"
EXPOSURE, SENSOR, MOST_PHOTONS = 0.05, (2304, 4096), 6e3
"""s; rows and columns; photons that fit into a pixel with room for noise (bright scenes are darker here)."""


def scene_of(number: int) -> dict[str, Any]:
    """The scene as configuration keys; a floating particle replaces that of the benchmark; there is no drift."""
    recipe = RECIPES[number]
    effects: list[Any] = ["pixel_area"]
    if recipe.fringes:
        delta_beta, distance, energy = OPTICS[recipe.sample]
        fringes = {"delta_beta": delta_beta, "distance": distance, "energy": energy, "method": "transport"}
        effects.append({"kind": "phase_fringes", **fringes})
    if recipe.crumb:
        width, middle = COLS * PITCH, (CRUMBED.start + CRUMBED.stop) // 2
        crumb = {
            "distance": [width / 2, width / 2], "count": 1, "size": [CRUMB_SIZE * PITCH] * 2, "depth": CRUMB_DEPTH,
            "heights": [0.0, 0.0], "motion": "loose", "speed": width / len(CRUMBED),
            "views": [middle, middle + 1], "seed": number,
        }  # fmt: skip
        effects.append({"kind": "floaters", **crumb})
    photons = {"photons_per_s": min(recipe.photons, MOST_PHOTONS) / EXPOSURE}
    return {"phantom": mapping_of(recipe, number), "beam": photons, "effects": [*effects, "photon_noise"]}


def config_of(number: int, **more: object) -> Config:
    """The scan of a scene; `more`: further values of the configuration."""
    recipe, (rows, cols) = RECIPES[number], SENSOR
    values: dict[str, object] = {
        "sample.name": f"next_pass_{number}",
        "scan.angles": {"scheme": "interlaced", "views": VIEWS, "passes": PASSES},
        "scan.exposure_s": EXPOSURE,
        "scan.flats": {"count": 50, "at": "both"},
        "devices.camera.roi": [(rows - ROWS) // 2, (cols - COLS) // 2, ROWS, COLS],
        "optics.pixel_size_um": 1e3 * PITCH,
        "optics.axis_col": (COLS - 1) / 2,
        "monitor.retake": ["floater"] if recipe.crumb else False,
        "simulation.clock": "virtual",
        "simulation.scene": scene_of(number),
    }
    if recipe.over > 1:
        values |= {"scan.offset_views": WIDE_ANGLES, "sample.diameter_mm": recipe.over * COLS * PITCH}
    return load(SHIPPED, [override_of(key, value) for key, value in (values | more).items()], {})


@dataclass(frozen=True, eq=False)
class Scanned:
    """A scan that decided: decisions and rows of its file, and real seconds from the last frame of a pass to each
    decision."""

    decisions: tuple[Mapping[str, Any], ...]
    rows: int
    waits: tuple[float, ...]
    seconds: float


def scanned(config: Config, folder: Path) -> Scanned:
    """Run a scan as `beamline scan` does, with its live reconstruction."""
    waits, decide = list[float](), Decider.__call__

    def timed(decider: Decider, passes: Passes) -> Choice:
        begin = time.monotonic()
        choice = decide(decider, passes)
        waits.append(time.monotonic() - begin)
        return choice

    begin, stop, path = time.monotonic(), StopRequest(), ""

    def note(event: Event) -> None:
        nonlocal path
        if isinstance(event, ScanDone):
            path = str(event.result.path)
        elif text := sentence(event):
            print(f"  {text}", file=sys.stderr, flush=True)

    how = commands_of(config)
    with patch.object(Decider, "__call__", timed), suppress(ScanStopped):
        run_scan(config, folder, [note], stop, live=how)
    with open_scan(path) as source:
        return Scanned(source.decisions, len(source.table), tuple(waits), time.monotonic() - begin)


def lines_of(scan: Scanned) -> list[str]:
    """A line of Markdown for each decision, and one for the scan."""
    lines = []
    for decision, wait in zip(scan.decisions, scan.waits, strict=False):
        gains = ", ".join(
            f"{option['choice']} {option['gain']:.2f}" for option in decision["options"] if option["gain"] is not None
        )
        gained = "" if decision["gained"] is None else f"{decision['gained']:.2f}"
        lines.append(
            f"| {decision['number']} | {decision['n_views']} | {decision['choice']} by {decision['by']} | {gains} "
            f"| {gained} | {wait:.1f} |"
        )
    return [*lines, f"{scan.rows} rows, {scan.seconds:.0f} s in all, real"]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", default="0,4,5,7")
    parser.add_argument("--set", action="append", default=[], help="KEY=VALUE of the configuration")
    arguments = parser.parse_args()
    for number in map(int, arguments.scenes.split(",")):
        more = {key: yaml.safe_load(value) for key, _, value in (word.partition("=") for word in arguments.set)}
        print(f"\nscene {number}, {RECIPES[number]}\n", flush=True)
        print("| pass | views | choice | gains in dB | gained by the last | s |\n|---|---|---|---|---|---|")
        scan = scanned(config_of(number, **{"scan.decide": "do", **more}), arguments.folder)
        print("\n".join(lines_of(scan)), flush=True)


if __name__ == "__main__":
    main()
