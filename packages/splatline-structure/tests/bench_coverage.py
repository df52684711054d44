"""Coverage of the intervals on simulated scenes: python bench_coverage.py built_on|built_on_too|looked_at_once [FOLDER]

For each scene the numbers of the truth's voxels, by the same code, and whether the intervals hold them. FOLDER keeps
the volumes.
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np
from grain_scenes import BUILT_ON, BUILT_ON_TOO, F32, LOOKED_AT_ONCE, Scene

import recon
from splatline_structure.intervals import measured_structure
from splatline_structure.materials import materials_of
from splatline_structure.numbers import Rules, structure_of
from splatline_structure.volumes import Box, inscribed_box

RULES = Rules(2, 1)
SHOWN = "fraction_2", "size_50", "surface", "tortuosity_z", "tortuosity_y", "tortuosity_x"
WALL = 4  # columns


def box_of(scene: Scene) -> Box:
    """The square inside the sample, without the can's wall, or inside the field."""
    middle, wall = (scene.columns - 1) / 2, WALL if scene.kind == "cathode" and scene.wide < 1 else 0
    return inscribed_box(scene.grid.shape, (middle, middle, min(scene.wide, 1.0) * scene.columns / 2 - wall), 0.05)


def volumes_of(scene: Scene, keep: Path | None = None) -> dict[str, F32]:
    """The truth, the volume, and those of both halves of the views."""
    if keep is not None and keep.is_file():
        with np.load(keep) as file:
            return {name: file[name] for name in ("truth", "full", "half0", "half1")}
    phantom = scene.phantom()
    data, views = scene.views_of(phantom), np.arange(scene.views)
    out = {"truth": scene.truth(phantom), "full": scene.reconstructed(data)}
    for k in (0, 1):
        geometry = scene.geometry.select(views[k::2])
        out[f"half{k}"] = recon.reconstruct(data[k::2], geometry, scene.method, grid=scene.grid).volume.data
    if keep is not None:
        np.savez(keep, **out)
    return out


def main(which: str, folder: Path | None) -> None:
    scenes = {"built_on": BUILT_ON, "built_on_too": BUILT_ON_TOO, "looked_at_once": LOOKED_AT_ONCE}[which]
    held: dict[str, list[bool]] = {name: [] for name in SHOWN}
    widths: dict[str, list[float]] = {name: [] for name in SHOWN}
    for number, scene in enumerate(scenes):
        volumes = volumes_of(scene, None if folder is None else folder / f"{number}.npz")
        box = box_of(scene)
        truth, full, *halves = (np.ascontiguousarray(each[box]) for each in volumes.values())
        known = structure_of(truth, materials_of(truth, 2).thresholds, (1, 1, 1), RULES).numbers
        found = measured_structure(full, halves, 2, (1, 1, 1), RULES)
        shown = []
        for name, each in found.intervals.items():
            if name in SHOWN and np.isfinite(known[name]) and not each.why_not:
                held[name].append(each.low <= known[name] <= each.high)
                widths[name].append((each.high - each.low) / abs(each.value))
            mark = "-" if each.why_not else "+" if each.low <= known[name] <= each.high else "!"
            shown.append(f"{name} {known[name]:.4g}: {each.value:.4g} ({each.low:.4g} to {each.high:.4g}) {mark}")
        print(scene, f"undecided {found.undecided:.3f}", *shown, sep="\n   ", flush=True)
    for name in SHOWN:
        print(f"{name:14s} {sum(held[name])} of {len(held[name])} held, median width {np.median(widths[name]):.1%}")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main(sys.argv[1], Path(sys.argv[2]) if len(sys.argv) > 2 else None)
