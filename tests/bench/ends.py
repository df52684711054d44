"""Benchmark of where methods end: what 200 further iterations change, and dB against the number of iterations.

python -m tests.bench.ends [--columns 192] [--views 30 45 90 180] [--photons 1e4] [--scene packed] [--methods NAME ...]
    [--half-voxels]

It prints a table with a row for each method and number of projections: how many iterations the default made, its PSNR,
the PSNR after 200 more with the same weights, and the PSNR after some smaller numbers of iterations. Scenes, noise and
PSNR are those of tests.bench.first_users. All voxels are as wide as pixels. With `--half-voxels`, the last iterations
of fista-tv and discrete use half voxels, and only these are counted.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import recon
from recon.auto import method_named
from recon.voxels.half_voxels import with_halves
from tests.bench.first_users import Cell, judged, noisy
from tests.bench.first_users_scenes import scene_of

METHODS = ["fista-tv", "discrete", "os-sirt-tv", "pnp-dct", "asd-pocs", "sirt"]
MORE = 200
SHARES = 0.25, 0.5
"""Parts of the default's number of iterations whose volumes are judged, too."""


def longer(method: Any, settings: Mapping[str, Any], iterations: int) -> Any:
    """The method with the weight that it chose, which makes so many iterations and does not end before."""
    changes: dict[str, Any] = {"iterations": iterations}
    if "tv_weight_chosen" in settings and hasattr(method, "tv_weight"):
        changes["tv_weight"] = settings["tv_weight_chosen"]
    if hasattr(method, "still"):
        changes["still"] = 0.0
    return replace(method, **changes)


def row(cell: Cell, name: str, on_halves: bool) -> str:
    scene = scene_of(cell.scene, cell.columns, cell.rows, cell.over, cell.views, cell.packing)
    views, rows = noisy(cell, scene), range(cell.rows)
    method = with_halves(method_named(name), on_halves)
    begin = time.process_time()
    default = recon.reconstruct(views, scene.geometry, method=method)
    seconds = time.process_time() - begin
    given = default.settings
    made = int(given.get("half_voxel_iterations", given.get("ended_after", given["iterations"])))
    ended = str(given.get("ended", "schedule"))
    decibels = judged(default.volume.data, scene, rows)[0]
    line = [name, str(cell.views), str(made), ended, f"{decibels:.2f}"]
    for iterations in (made + MORE, *(max(1, round(share * made)) for share in SHARES)):
        other = longer(method, given, iterations)
        volume = recon.reconstruct(views, scene.geometry, method=other).volume.data
        line.append(f"{judged(volume, scene, rows)[0]:.2f}")
    return "| " + " | ".join([*line, f"{seconds:.1f}"]) + " |"


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="packed")
    parser.add_argument("--columns", type=int, default=192)
    parser.add_argument("--views", type=int, nargs="+", default=[30, 45, 90, 180])
    parser.add_argument("--photons", type=float, default=1e4)
    parser.add_argument("--packing", type=int, default=0)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--half-voxels", action="store_true")
    asked = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    print("| method | projections | iterations | how it ended | PSNR (dB) | 200 iterations more (dB) "
          "| a quarter of them (dB) | half of them (dB) | CPU (s) |\n" + "|---" * 9 + "|")  # fmt: skip
    for views in asked.views:
        cell = Cell(asked.scene, asked.columns, views, 1.0, asked.photons, 0, asked.packing)
        for name in asked.methods:
            print(row(cell, name, asked.half_voxels), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
