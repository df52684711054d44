"""Benchmark of a reference scan: states of packed balls from few views, with and without the scan before they changed.

python -m tests.bench.operando [--scenes can fine ...] [--views 30 60] [--photons 1e4] [--seeds 11] [--reference right]

It prints a row for each case: PSNR in the whole and in what changed, mean depth of cracks, and processor time of
`auto`, of the best total variation by the truth, and of `FromReference`; which method `auto` chose, whether the
reference was used, and what remains of two balls that are gone. The truth is not projected by recon, see
`tests.bench.operando_scenes`. References: right; other (another packing); shifted (10 voxels off); turned (3 degrees
more); energy (other grey levels); changed (two thirds of the balls have grown, moved and changed their levels).
With --baselines it prints the same figures of published methods that get the moved reference of `FromReference`, see
`tests.bench.operando_baselines`; the best of their weights by the truth.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage as ndi

import recon
from recon.base.arrays import F32
from recon.base.volume import Volume
from tests.bench.operando_baselines import of_series, volumes
from tests.bench.operando_scenes import SCENES, Judge, State, paint, scanned, scene

STATE = 3
WEIGHTS = 3.5e-4, 7e-4, 1.4e-3, 2.8e-3, 5.6e-3  # of total variation; the best by the truth is the baseline
REFERENCES = "right", "other", "shifted", "turned", "energy", "changed"
BASELINES = "piccs", "dtv", "rest", "start", "series"


@dataclass(frozen=True)
class Case:
    scene: str
    views: int
    photons: float
    seed: int
    reference: str
    columns: int = 160
    rows: int = 4

    @property
    def angles(self) -> NDArray[np.float64]:
        return np.arange(self.views) * np.pi / self.views


def scanned_before(before: State, seed: int) -> tuple[F32, NDArray[np.float64]]:
    """Line integrals of the reference scan, and their angles."""
    angles = np.arange(360) * np.pi / 360
    return scanned(paint(before)[0], angles, 1e4, np.random.default_rng([3, seed])), angles


@cache
def reference(name: str, kind: str, seed: int, columns: int, rows: int) -> Volume:
    """The volume of 360 views of the scene before it changed, or another one."""
    before = scene(name, columns, rows, seed + 1000 * (kind == "other"))[0][0]
    if kind == "energy":
        balls = before.balls * [1, 1, 1, 1, 0.7]
        can = (*before.can[:2], before.can[2] * 0.8)
        before = replace(before, balls=balls, matrix=(before.matrix[0], before.matrix[1] * 0.9), can=can)
    if kind == "changed":
        before = replace(before, balls=_mostly_changed(before.balls, np.random.default_rng([5, seed])))
    lines, angles = scanned_before(before, seed)
    made = recon.reconstruct(lines, recon.Geometry.parallel(angles, lines.shape[1:]), recon.FistaTv()).volume
    if kind == "shifted":
        made = replace(made, data=np.roll(made.data, (6, -8), (1, 2)))
    if kind == "turned":
        made = replace(made, data=ndi.rotate(made.data, 3, (1, 2), reshape=False, order=1))
    return made


def _mostly_changed(balls: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Balls of which two thirds were smaller by 10 to 40 %, elsewhere within their place, of a level up to 30 % off."""
    before, some = balls.copy(), rng.random(len(balls)) < 2 / 3
    n = some.sum()
    share, way = rng.uniform(0.6, 0.9, n), rng.normal(size=(n, 3))
    way *= (rng.random(n) * (1 - share) * balls[some, 3] / np.linalg.norm(way, axis=1))[:, None]
    before[some, :3] += way
    before[some, 3] *= share
    before[some, 4] *= rng.uniform(0.7, 1.3, n)
    return before


def _of(case: Case) -> tuple[Judge, F32, recon.Geometry, Volume]:
    """The judge of a case, its line integrals and their geometry, and the reference."""
    states, what = scene(case.scene, case.columns, case.rows, case.seed)
    judge, rng = Judge(states, what, STATE), np.random.default_rng([7, case.views, int(case.photons), case.seed])
    lines = scanned(paint(states[STATE])[0], case.angles, case.photons, rng)
    geometry = recon.Geometry.parallel(case.angles, lines.shape[1:])
    earlier = reference(case.scene, case.reference, case.seed, case.columns, case.rows)
    return judge, lines, geometry, earlier


def _cells(judge: Judge, x: F32) -> str:
    return f"{judge.psnr(x):.2f} | {judge.psnr(x, judge.changed):.2f} | {judge.depths(x).mean():.2f}"


def row_of_baselines(case: Case) -> str:
    judge, lines, geometry, earlier = _of(case)
    made = recon.reconstruct(lines, geometry, recon.FromReference(earlier))
    begin = f"| {case.scene} {case.seed}, {case.reference} | {case.views} | {case.photons:g} | "
    if made.change is None:
        return f"{begin}not used |" + " |" * (3 * len(BASELINES) + 3)
    others = volumes(lines, geometry, replace(made.volume, data=made.volume.data - made.change.data))
    before = scene(case.scene, case.columns, case.rows, case.seed)[0][0]
    others["series"] = [of_series(*scanned_before(before, case.seed), lines, geometry)]
    best = [max(others[name], key=judge.psnr) for name in BASELINES]
    return f"{begin}used | {' | '.join(_cells(judge, x) for x in (*best, made.volume.data))} |"


def row(case: Case) -> str:
    judge, lines, geometry, earlier = _of(case)

    def timed(make: Callable[[], recon.Reconstruction]) -> tuple[recon.Reconstruction, float]:
        begin = time.process_time()
        return make(), time.process_time() - begin

    auto, seconds_auto = timed(lambda: recon.reconstruct(lines, geometry, "auto"))
    mine, seconds = timed(lambda: recon.reconstruct(lines, geometry, recon.FromReference(earlier)))
    smooth = [recon.reconstruct(lines, geometry, recon.FistaTv(tv_weight=weight)).volume.data for weight in WEIGHTS]
    best = max(smooth, key=judge.psnr)
    cells = [_cells(judge, x) for x in (auto.volume.data, best, mine.volume.data)]
    shallower = int((judge.depths(mine.volume.data) < 0.9 * judge.depths(best)).sum())
    used = "used" if mine.settings["reference_used"] else "not used"
    if mine.method == auto.method and np.array_equal(mine.volume.data, auto.volume.data):
        used += ", to the bit"
    return (
        f"| {case.scene} {case.seed}, {case.reference} | {case.views} | {case.photons:g} | {auto.method} | "
        f"{' | '.join(cells)} | {used} | {judge.ghosts(mine.volume.data):.3f} | {shallower} of {len(judge.cracks)} | "
        f"{seconds_auto:.1f} | {seconds:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--views", nargs="+", type=int, default=[30, 60])
    parser.add_argument("--photons", nargs="+", type=float, default=[1e4, 1e3])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--reference", nargs="+", default=["right"], choices=REFERENCES)
    parser.add_argument("--columns", type=int, default=160)
    parser.add_argument("--rows", type=int, default=4)
    parser.add_argument("--baselines", action="store_true")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    names = (*BASELINES, "reference") if given.baselines else ("auto", "TV", "reference")
    figures = " | ".join(f"{name}: dB | in what changed | depth of cracks" for name in names)
    others = "reference | ghost | shallower than TV | auto s | with reference s |"
    head = f"reference | {figures} |" if given.baselines else f"auto chose | {figures} | {others}"
    print(f"| scene, reference | views | photons | {head}")
    for each in product(given.scenes, given.views, given.photons, given.seeds, given.reference):
        print((row_of_baselines if given.baselines else row)(Case(*each, given.columns, given.rows)), flush=True)


if __name__ == "__main__":
    main()
