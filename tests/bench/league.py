"""Benchmark: our methods and all installed packages on the same scans, with default and best settings.

python -m tests.bench.league SCORES.json [--scans "bone;Diamond"] [--of svmbir] [--small] > table.md adds scores to the
file and prints the table of all scores in it. pip install ".[league]" installs the other packages that need no
compiler. ASTRA (GPL) and mbirjax (JAX) take part if they are installed.

The scans have 50 projections with 10⁵ photons, from exact strip integrals through voxels half as wide (a cone: four
rays per pixel through voxels a quarter as wide); in addition, Diamond's scan. There are 129 columns, so that the axis
is in the middle of a pixel, as scikit-image assumes. PSNR in dB inside the cylinder that all projections see, with
values clipped at 0. For Diamond: -20 log10 of the RMS residual in projections that were never used, from strip
integrals through the volume, which no method uses itself. The best setting is the one with the highest of these values,
which a user cannot know. Two threads; each competitor has its own process, whose peak memory includes its imports. CPU
seconds are for the volume alone, after compilation.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.assess.metrics import psnr
from tests.bench import quality_cases
from tests.bench.league_peers import LEAGUE
from tests.bench.quality_cases import (
    TEXTURED,
    Case,
    cone,
    diamond,
    rows_of,
    seen_by_simulator,
    slab,
    strip_integrals,
)

F32 = NDArray[np.float32]
VIEWS, PHOTONS, THREADS = 50, 1e5, 2
SLICES = 2  # number of slices for a competitor that treats slices independently
DATA = Path("../shared/data")


class Score(NamedTuple):
    """A setting with its quality in dB, CPU seconds and peak memory of the process in MB."""

    setting: str
    quality: float
    seconds: float
    memory: float


def _odd(name: str) -> Callable[[Path], Case]:
    """The `slab` with one more column and row."""

    def load(folder: Path) -> Case:
        fine = {**quality_cases.SLABS, **TEXTURED}[name]
        quality_cases.SLABS["odd"] = lambda where: np.pad(fine(where), ((0, 0), (0, 2), (0, 2)))
        return slab(folder, "odd", VIEWS, PHOTONS)

    return load


SCANS: dict[str, Callable[[Path], Case]] = {
    "bone": _odd("bone"),
    "cement": _odd("cement"),
    "thorax": _odd("thorax"),
    "bone, fine structure": _odd("bone, binned"),
    "cement, fine structure": _odd("cement, binned"),
    "teapot, cone": lambda folder: cone(folder, "teapot", VIEWS, 64, seen_by_simulator),
    "Diamond": lambda folder: diamond(folder, 76),
}


def smaller(case: Case, rows: int = 4) -> Case:
    """Only the middle rows, for a test; a cone is unchanged."""
    geometry = case.geometry
    if geometry.is_cone:
        return case
    first = (geometry.detector_shape[0] - rows) // 2
    return rows_of(case, range(first, first + rows))


def judged(case: Case, volume: F32) -> float:
    """Quality in dB of a volume [z, y, x] in 1/pixel."""
    volume = (np.maximum(volume, 0) / np.float32(case.geometry.sample_pitch)).astype(np.float32)
    if case.unseen is not None:
        views, geometry, counts = case.unseen
        left = (strip_integrals(volume, geometry) - views)[counts]
        return -10 * float(np.log10(np.mean(np.square(left, dtype=np.float64))))
    y, x = (np.arange(n) - (n - 1) / 2 for n in volume.shape[1:])
    seen = np.hypot(y[:, None], x) < volume.shape[2] / 2
    return psnr(case.truth[:, seen], volume[:, seen], case.peak)


def peak_memory() -> float:
    """Peak memory of this process in MB."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1024


def play(name: str, case: Case) -> list[Score]:
    """Run one competitor on one case with each setting."""
    competitor, share = LEAGUE[name], 1.0
    rows = case.geometry.detector_shape[0]
    if competitor.slice_by_slice and not case.geometry.is_cone and rows > SLICES:
        case, share = rows_of(case, [rows * (2 * k + 1) // (2 * SLICES) for k in range(SLICES)]), rows / SLICES
    competitor.prepare(case)
    scores: list[Score] = []
    for setting, make in competitor.settings.items():
        try:
            if competitor.compiles and not scores:
                make(case)
            begin = time.process_time()
            volume = make(case)
        except NotImplementedError:
            continue
        seconds = (time.process_time() - begin) * share
        scores.append(Score(setting, judged(case, volume), seconds, peak_memory()))
    return scores


def _child(name: str, case: Case) -> list[Score]:
    warnings.simplefilter("ignore")
    os.dup2(2, 1)  # output of other packages must not go into the table
    return play(name, case)


def _cell(score: Score) -> str:
    seconds = f"{score.seconds:.0f}" if score.seconds >= 10 else f"{score.seconds:.2g}"
    return f"{score.quality:.2f}, {seconds} s"


def table(scores: dict[str, dict[str, list[Score]]]) -> str:
    """Markdown: each competitor with its default and below it with its best setting; memory: largest of all scans."""
    scans = list(scores)
    lines = ["| | " + " | ".join(scans) + " | MB |", "|---" * (len(scans) + 2) + "|"]
    for name in LEAGUE:
        rows = [scores[scan].get(name, []) for scan in scans]
        if not any(rows):
            continue
        memory = f"{max(score.memory for some in rows for score in some):.0f}"
        default = [_cell(some[0]) if some else "" for some in rows]
        lines.append(f"| {name}, {LEAGUE[name].default} | " + " | ".join(default) + f" | {memory} |")
        if len(LEAGUE[name].settings) > 1:
            best = [max(some, key=lambda score: score.quality) if some else None for some in rows]
            cells = [f"{_cell(one)} ({one.setting})" if one else "" for one in best]
            lines.append(f"| {name}, best | " + " | ".join(cells) + " | |")
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scores", type=Path)
    parser.add_argument("--scans", default=";".join(SCANS), help="parted by semicolons")
    parser.add_argument("--of", default=";".join(LEAGUE), help="competitors, parted by semicolons")
    parser.add_argument("--small", action="store_true", help="four rows each")
    asked = parser.parse_args(arguments)
    for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = str(THREADS)  # for the processes of the competitors
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:THREADS])
    kept = json.loads(asked.scores.read_text()) if asked.scores.exists() else {}
    for scan in asked.scans.split(";"):
        case = smaller(SCANS[scan](DATA)) if asked.small else SCANS[scan](DATA)
        for name in filter(lambda name: LEAGUE[name].is_installed, asked.of.split(";")):
            with multiprocessing.get_context("spawn").Pool(1) as process:
                kept.setdefault(scan, {})[name] = process.apply(_child, (name, case))
            print(scan, name, *kept[scan][name], file=sys.stderr, flush=True)
            asked.scores.write_text(json.dumps(kept))
    order = [scan for scan in SCANS if scan in kept]
    print(table({scan: {name: [Score(*s) for s in some] for name, some in kept[scan].items()} for scan in order}))


if __name__ == "__main__":
    main(sys.argv[1:])
