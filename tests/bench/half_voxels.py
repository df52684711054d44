"""Benchmark of half voxels: volumes with whole voxels only, and with half voxels in the last iterations.

python -m tests.bench.half_voxels [--columns 192] [--views 30 45 90] [--photons 1e4] [--scene cracks] [--packing 1]
    [--over 1] [--data FOLDER]

It prints a table with a row for each method and number of projections. Scenes, noise, PSNR, wrong voxels and depths of
cracks are those of tests.bench.first_users; `--over` is the width of the sample divided by that of the field of view,
and the scene `cone` is a cone beam. With the folder of real scans, it also prints the residual in projections that were
not used: Diamond with 76 projections and a walnut with 60, whole and cut to columns that do not contain the sample.
There the small voxels themselves are projected in the second figure, and their means in the third. The third table is
the PSNR of total variation in a cone beam: volumes of 64³ voxels from 20 projections that the simulator made from 256³.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

import recon
from recon.base.decisions import Decisions
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.half_voxels import HALVES, halved
from recon.voxels.projector import Projector
from tests.bench.first_users import Cell, judged, noisy
from tests.bench.first_users_scenes import scene_of
from tests.bench.quality_cases import OBJECTS, Case, diamond, padded, seen_by_simulator, walnut_held_out
from tests.bench.quality_cases import noisy as with_noise

METHODS = recon.FistaTv, recon.Discrete
CUT = 64  # columns that are kept
SIDE, CONE_VIEWS, SOURCE = 64, 20, 8.0  # of a cone beam: voxels and pixels a side, projections, distance of the source
HEAD = ["method", "projections", "voxels", "PSNR (dB)", "wrong (%)", "depth of thin cracks", "CPU (s)"]


def untested() -> recon.RunControl:
    """Half voxels are used although held-out projections might show that they predict worse."""
    return recon.RunControl(decide=Decisions(0, {HALVES: [True]}))


def rows(cell: Cell) -> list[str]:
    scene = scene_of(cell.scene, cell.columns, cell.rows, cell.over, cell.views, cell.packing)
    views, lines = noisy(cell, scene), []
    for method in METHODS:
        for wanted, voxels in ((False, "whole"), (True, "half")):
            begin = time.process_time()
            made = recon.reconstruct(views, scene.geometry, method=method(half_voxels=wanted), control=untested())
            seconds = time.process_time() - begin
            quality, _, wrong, thin, *_ = judged(made.volume.data, scene, range(cell.rows))
            depth = "" if thin is None else f"{thin:.2f}"
            cells = [method.name, f"{cell.views}", voxels, f"{quality:.2f}", f"{100 * wrong:.2f}", depth]
            lines.append("| " + " | ".join([*cells, f"{seconds:.1f}"]) + " |")
    return lines


def cut(case: Case) -> Case:
    """The case with the columns around the axis only, which do not contain the sample."""
    first = round(case.geometry.axis_col - (CUT - 1) / 2)
    kept = slice(first, first + CUT)

    def narrow(geometry: Geometry) -> Geometry:
        shape = geometry.detector_shape[0], CUT
        return replace(geometry, detector_shape=shape, axis_col=geometry.axis_col - first)

    assert case.unseen is not None
    views, geometry, rays = case.unseen
    return replace(
        case, name=f"{case.name}, {CUT} columns", projections=np.ascontiguousarray(case.projections[..., kept]),
        geometry=narrow(case.geometry), grid=Grid.matching(narrow(case.geometry)),
        weights=None if case.weights is None else np.ascontiguousarray(case.weights[..., kept]),
        unseen=(views[..., kept], narrow(geometry), rays[..., kept]),
    )  # fmt: skip


def unseen_residual(case: Case, made: recon.Reconstruction) -> float:
    """Root mean square residual in the projections that were not used."""
    assert case.unseen is not None
    views, geometry, rays = case.unseen
    model = Projector(geometry, made.volume.grid).forward(made.volume.data)
    if made.outside is not None:
        model += made.outside(geometry)
    return float(np.sqrt(np.mean(np.square(model - views)[rays])))


def measured(case: Case) -> str:
    use = None if case.weights is None else recon.DataUse(weights=case.weights)
    residuals = []
    for grid, wanted in ((case.grid, False), (halved(case.grid), False), (case.grid, True)):
        method = recon.FistaTv(half_voxels=wanted)
        made = recon.reconstruct(case.projections, case.geometry, method=method, use=use, grid=grid, control=untested())
        residuals.append(f"{unseen_residual(case, made):.5f}")
    return "| " + " | ".join([case.name, *residuals]) + " |"


def in_a_cone(folder: Path, name: str) -> str:
    fine = padded(OBJECTS[name](folder), 256)
    angles, factor = np.linspace(0, 2 * np.pi, CONE_VIEWS, endpoint=False), 256 // SIDE
    geometry = Geometry.cone(angles, (SIDE, SIDE), 2 / SIDE, SOURCE, SOURCE)
    views = with_noise(seen_by_simulator(fine, geometry))
    truth = fine.reshape(SIDE, factor, SIDE, factor, SIDE, factor).mean((1, 3, 5))
    cells = [name]
    for wanted in (False, True):
        made = recon.reconstruct(views, geometry, method=recon.FistaTv(half_voxels=wanted), control=untested())
        cells.append(f"{-10 * np.log10(np.mean(np.square(made.volume.data - truth))):.2f}")
    return "| " + " | ".join(cells) + " |"


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="cracks")
    parser.add_argument("--columns", type=int, default=192)
    parser.add_argument("--views", type=int, nargs="+", default=[30, 45, 90])
    parser.add_argument("--photons", type=float, default=1e4)
    parser.add_argument("--packing", type=int, default=1)
    parser.add_argument("--over", type=float, default=1.0)
    parser.add_argument("--data", type=Path)
    asked = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    print("| " + " | ".join(HEAD) + " |\n" + "|---" * len(HEAD) + "|")
    for views in asked.views:
        cell = Cell(asked.scene, asked.columns, views, asked.over, asked.photons, 0, asked.packing)
        print(*rows(cell), sep="\n", flush=True)
    if asked.data is not None:
        print("\n| scan | whole voxels | half voxels | their means |\n|---|---|---|---|")
        for case in (diamond(asked.data, 76), walnut_held_out(asked.data)):
            print(measured(case), measured(cut(case)), sep="\n", flush=True)
        print("\n| cone beam | whole voxels (dB) | half voxels (dB) |\n|---|---|---|")
        for name in OBJECTS:
            print(in_a_cone(asked.data, name), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
