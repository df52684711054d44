"""Benchmark of half voxels: volumes with whole voxels only, and with half voxels in the last iterations.

python -m tests.bench.half_voxels [--columns 192] [--views 30 45 90] [--photons 1e4] [--scene cracks] [--packing 1]
    [--data FOLDER]

It prints a table with a row for each method and number of projections. Scenes, noise, PSNR, wrong voxels and depths of
cracks are those of tests.bench.first_users. With the folder of real scans, it also prints the residual in projections
that were not used: Diamond with 76 projections and a walnut with 60. There the small voxels themselves are projected in
the second figure, and their means in the third.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import recon
from recon.base.volume import Grid
from recon.voxels.half_voxels import halved
from recon.voxels.projector import Projector
from tests.bench.first_users import Cell, judged, noisy
from tests.bench.first_users_scenes import scene_of
from tests.bench.quality_cases import Case, diamond, walnut_held_out

METHODS = recon.FistaTv, recon.Discrete
HEAD = ["method", "projections", "voxels", "PSNR (dB)", "wrong (%)", "depth of thin cracks", "CPU (s)"]


def rows(cell: Cell) -> list[str]:
    scene = scene_of(cell.scene, cell.columns, cell.rows, cell.over, cell.views, cell.packing)
    views, lines = noisy(cell, scene), []
    for method in METHODS:
        for wanted, voxels in ((False, "whole"), (True, "half")):
            begin = time.process_time()
            made = recon.reconstruct(views, scene.geometry, method=method(half_voxels=wanted))
            seconds = time.process_time() - begin
            quality, _, wrong, thin, *_ = judged(made.volume.data, scene, range(cell.rows))
            depth = "" if thin is None else f"{thin:.2f}"
            cells = [method.name, f"{cell.views}", voxels, f"{quality:.2f}", f"{100 * wrong:.2f}", depth]
            lines.append("| " + " | ".join([*cells, f"{seconds:.1f}"]) + " |")
    return lines


def unseen_residual(case: Case, grid: Grid, data: Any) -> float:
    """Root mean square residual in the projections that were not used."""
    assert case.unseen is not None
    views, geometry, rays = case.unseen
    return float(np.sqrt(np.mean(np.square(Projector(geometry, grid).forward(data) - views)[rays])))


def measured(case: Case) -> str:
    use = None if case.weights is None else recon.DataUse(weights=case.weights)
    residuals = []
    for grid, wanted in ((case.grid, False), (halved(case.grid), False), (case.grid, True)):
        method = recon.FistaTv(half_voxels=wanted)
        made = recon.reconstruct(case.projections, case.geometry, method=method, use=use, grid=grid)
        residuals.append(f"{unseen_residual(case, grid, made.volume.data):.5f}")
    return "| " + " | ".join([case.name, *residuals]) + " |"


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="cracks")
    parser.add_argument("--columns", type=int, default=192)
    parser.add_argument("--views", type=int, nargs="+", default=[30, 45, 90])
    parser.add_argument("--photons", type=float, default=1e4)
    parser.add_argument("--packing", type=int, default=1)
    parser.add_argument("--data", type=Path)
    asked = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    print("| " + " | ".join(HEAD) + " |\n" + "|---" * len(HEAD) + "|")
    for views in asked.views:
        cell = Cell(asked.scene, asked.columns, views, 1.0, asked.photons, 0, asked.packing)
        print(*rows(cell), sep="\n", flush=True)
    if asked.data is not None:
        print("\n| scan | whole voxels | half voxels | their means |\n|---|---|---|---|")
        for case in (diamond(asked.data, 76), walnut_held_out(asked.data)):
            print(measured(case), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
