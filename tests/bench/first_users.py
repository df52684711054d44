"""Benchmark of the first users' scan: packed samples from few projections, with our methods and other packages.

python -m tests.bench.first_users SCORES.json --columns 512 --views 90 --best > tables.md adds the missing scores to
SCORES.json, one volume at a time, and prints the tables of all requested cells. Several calls may add to one file at
the same time. Other packages take part if they are installed, see tests.bench.league.

Scenes: see tests.bench.first_users_scenes. A scan has 16 rows, or 8 from 2048 columns on. The noise is that of the
    given number of photons per pixel in the open beam. Seeds are for the noise only; other packings of the sample have
    their own numbers. "wide" is another package's own way to treat a sample wider than the field: it is given the width
    of the sample and reconstructs slices of that width.

dB: PSNR within 0.95 of the field's circle, over the largest density, values clipped at 0. Fraction: share of voxels
    above the threshold (the middle between matrix and grains) inside the wall of the can, divided by the true share.
    Wrong: share of these voxels that are on the other side of the threshold than in the ground truth. Cracks: depth
    divided by the true depth, for widths of 0.5 to 1, 1 to 1.5 and 1.5 to 2 voxels, see `crack_depths`. CPU seconds:
    for the volume alone, on one thread by default, after compilation. Memory: peak of the process that makes only this
    volume, with its imports.

The best setting is the one with the highest dB, which a user cannot know. For the first seed, the search starts at the
first value and climbs until it has found lower quality on both sides; further seeds use that setting. If slices are
independent (ASTRA), only two rows are reconstructed and their time is scaled to all rows; for `cracks` all rows are
reconstructed.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import math
import multiprocessing
import os
import resource
import signal
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from itertools import pairwise, product
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from recon.base.volume import Grid
from tests.bench.first_users_scenes import SCENES, Planes, Scene, scene_of
from tests.bench.league import SLICES, peak_memory
from tests.bench.league_peers import DEFAULT, ENTRANTS, Value
from tests.bench.quality_cases import Case, rows_of

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Depths = tuple[float | None, float | None, float | None]
VERSION = 3
"""Version of scenes and figures; scores of different versions must not be in the same table."""
BESIDE, ACROSS, POINTS, FEWEST = 2.5, 0.6, 60, 15
"""Distance in voxels of the planes next to a crack; size of the disc divided by that of the crack; points; fewest."""
WIDTHS = 0.5, 1.0, 1.5, 2.0
"""Limits, in voxels, between the width classes of cracks."""


class Cell(NamedTuple):
    """One noisy scan; `over`: width of the sample divided by the field of view."""

    scene: str
    columns: int
    views: int
    over: float
    photons: float
    seed: int
    packing: int = 0

    @property
    def rows(self) -> int:
        return 8 if self.columns >= 2048 else 16

    def __str__(self) -> str:
        return f"{self.scene}|{self.columns}|{self.views}|{self.over:g}|{self.photons:g}|{self.seed}|{self.packing}"


class Score(NamedTuple):
    """Figures of a volume, see above; without a quality, it was ended after these seconds."""

    quality: float | None
    fraction: float | None
    wrong: float | None
    thin: float | None
    medium: float | None
    thick: float | None
    seconds: float
    memory: float


def crack_depths(volume: F32, truth: F32, planes: Planes) -> Depths:
    """Depth of cracks divided by the true depth, for each width class of `WIDTHS`; None: there is no such crack.

    The depth is the mean of a disc in the crack below that of two discs `BESIDE` voxels beside it, all within the same
    ball, by linear interpolation. Discs of which fewer than 15 of 60 points lie in the rows and within 0.95 of the
    field do not count.
    """
    turn, out = np.arange(POINTS) * np.pi * (3 - math.sqrt(5)), np.sqrt((np.arange(POINTS) + 0.5) / POINTS)
    least = np.eye(3)[np.argmin(np.abs(planes.normal), axis=1)]
    one = np.cross(planes.normal, least)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    other = np.cross(planes.normal, one)
    flat = out * np.cos(turn) * one[..., None] + out * np.sin(turn) * other[..., None]
    disc = planes.centre[..., None] + ACROSS * planes.radius[:, None, None] * flat  # [plane, xyz, point]
    middle = (np.array(volume.shape[::-1]) - 1) / 2
    discs = [disc + beside * planes.normal[..., None] for beside in (-BESIDE, 0, BESIDE)]
    within = [
        (np.abs(at[:, 2]) <= middle[2]) & (np.hypot(at[:, 0], at[:, 1]) < 0.95 * volume.shape[2] / 2) for at in discs
    ]
    counts = np.logical_and.reduce(within)

    def depth(of: F32) -> F64:
        places = [(at + middle[:, None])[:, ::-1].transpose(1, 0, 2) for at in discs]
        low, own, high = (map_coordinates(of, at, order=1, mode="nearest", output=np.float64) for at in places)
        return np.asarray((((low + high) / 2 - own) * counts).sum(1))

    made, true, some = depth(volume), depth(truth), counts.sum(1) >= FEWEST
    wide = [some & (low <= planes.width) & (planes.width < high) for low, high in pairwise(WIDTHS)]
    thin, medium, thick = (float(made[each].sum() / true[each].sum()) if each.any() else None for each in wide)
    return thin, medium, thick


def judged(volume: F32, scene: Scene, rows: Sequence[int]) -> tuple[float, float, float, *Depths]:
    """dB, fraction of grains divided by the true one, share of wrong voxels, and depths of cracks (if all rows
    exist)."""
    volume, truth = np.maximum(volume, 0), scene.truth[list(rows)]
    x = np.arange(truth.shape[2]) - (truth.shape[2] - 1) / 2
    away, field = np.hypot(x[:, None], x), 0.95 * truth.shape[2] / 2
    error = np.mean(np.square(volume - truth, dtype=np.float64)[:, away < field])
    inside, half_way = away < min(field, scene.inner - 2), sum(scene.levels) / 2
    made, true = (each[:, inside] > half_way for each in (volume, truth))
    whole = scene.planes is not None and len(rows) == len(scene.truth)
    depths = crack_depths(volume, truth, scene.planes) if whole and scene.planes else (None, None, None)
    quality = 10 * math.log10(float(scene.truth.max()) ** 2 / error)
    return quality, float(made.mean() / true.mean()), float((made != true).mean()), *depths


def noisy(cell: Cell, scene: Scene) -> F32:
    """Line integrals [view, row, col] with the noise of the cell's number of photons."""
    rng = np.random.default_rng([cell.seed, cell.columns, cell.views])
    counts = rng.poisson(cell.photons * np.exp(-scene.clean.astype(np.float64)))
    return -np.log(np.maximum(counts, 1) / cell.photons).astype(np.float32)


def _child(name: str, value: Value, over: float, case: Case, limit: float, into: Path, answer: Connection) -> None:
    warnings.simplefilter("ignore")
    os.dup2(2, 1)  # output of other packages must not go into the table
    competitor = ENTRANTS[name].of(value, over)
    make = competitor.settings[DEFAULT]
    competitor.prepare(case)
    if competitor.compiles:
        make(case)
    begin = time.process_time()
    resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(begin + limit), resource.RLIM_INFINITY))
    volume = make(case)
    seconds = time.process_time() - begin
    np.save(into, volume)
    answer.send((seconds, peak_memory()))


def play(cell: Cell, name: str, value: Value, limit: float) -> Score | None:
    """Make one volume in a separate process; None: it failed, and stderr gives the reason."""
    scene = scene_of(cell.scene, cell.columns, cell.rows, cell.over, cell.views, cell.packing)
    rows, views = list(range(cell.rows)), noisy(cell, scene)
    case = Case(cell.scene, views, scene.geometry, Grid.matching(scene.geometry), np.empty((cell.rows, 0, 0), "f4"), 1)
    if ENTRANTS[name].of(value, cell.over).slice_by_slice and scene.planes is None:
        rows = [cell.rows * (2 * k + 1) // (2 * SLICES) for k in range(SLICES)]
        case = rows_of(case, rows)
    share, spawn = cell.rows / len(rows), multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        into, (ours, theirs) = Path(folder) / "volume.npy", spawn.Pipe(duplex=False)
        process = spawn.Process(target=_child, args=(name, value, cell.over, case, limit / share, into, theirs))
        process.start()
        theirs.close()
        process.join()
        if process.exitcode == -signal.SIGXCPU:
            return Score(None, None, None, None, None, None, limit, 0.0)
        if process.exitcode:
            print(f"{cell} {name}: ended with status {process.exitcode}", file=sys.stderr, flush=True)
            return None
        seconds, memory = ours.recv()
        return Score(*judged(np.load(into), scene, rows), seconds * share, memory)


class Kept:
    """Scores in a file to which several processes may add."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.scores = self._read()

    def _read(self) -> dict[str, Score]:
        """Raises ValueError: the file was not written by this version of the bench, or is damaged."""
        if not self.path.exists():
            return {}
        advice = "give another file, or delete it"
        try:
            document = json.loads(self.path.read_text(encoding="utf-8"))
            version, rows = document["version"], dict(document["first_users"])
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{self.path} does not hold scores of first_users ({error!r}); {advice}") from error
        if version != VERSION:
            raise ValueError(f"{self.path} has scores of version {version}, and these are {VERSION}; {advice}")
        for key, row in rows.items():
            parts = key.split("|")
            numbers = isinstance(row, list) and all(isinstance(x, int | float) for x in row if x is not None)
            good = (
                len(parts) == 9
                and parts[0] in SCENES
                and parts[7] in ENTRANTS
                and numbers
                and len(row) == len(Score._fields)
            )
            if not good or None in row[-2:] or not all(math.isfinite(x) for x in row if x is not None):
                raise ValueError(f"{self.path}: the score {key!r}: {row!r} is damaged; delete it, or {advice}")
        return {key: Score(*row) for key, row in rows.items()}

    def change(self, change: Callable[[dict[str, Score]], dict[str, Score]]) -> None:
        """Change the present content of the file; other processes may have added to it."""
        with self.path.with_suffix(".lock").open("w", encoding="ascii") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            self.scores = change(self._read())
            part = self.path.with_suffix(".part")
            part.write_text(json.dumps({"version": VERSION, "first_users": self.scores}, indent=0), encoding="utf-8")
            part.replace(self.path)

    def score(self, cell: Cell, name: str, setting: Value, limit: float) -> Score | None:
        """The score in the file, or a new one; a score that was ended by the limit is repeated if the limit is higher
        now."""
        key = f"{cell}|{name}|{setting}"
        kept = self.scores.get(key)
        if kept is None or (kept.quality is None and kept.seconds < limit):
            kept = play(cell, name, None if setting == DEFAULT else setting, limit)
            if kept is not None:
                print(key, *kept, file=sys.stderr, flush=True)
                new = {key: kept}
                self.change(lambda scores: scores | new)
        return kept

    def of(self, cell: Cell, name: str) -> dict[str, Score]:
        """The scores of a method by setting."""
        start = f"{cell}|{name}|"
        return {key.removeprefix(start): score for key, score in self.scores.items() if key.startswith(start)}


def climb(quality: Callable[[Value], float], at: Callable[[int], Value]) -> Value:
    """The best setting: from number 0 up or down until the quality is lower on both sides, or there are no more."""

    def of(k: int) -> float:
        value = at(k)
        return -math.inf if value is None else quality(value)

    best, top = 0, of(0)
    for step in (1, -1):
        while (higher := of(best + step)) > top:
            best, top = best + step, higher
        if best > 0:
            break  # lower values were already tried
    return at(best)


def play_all(kept: Kept, cells: Sequence[Cell], names: Sequence[str], best: bool, limit: float) -> None:
    """Each method's default for each cell, and its best setting."""
    for cell, name in product(cells, names):
        entrant = ENTRANTS[name]
        if (entrant.wide_alone and cell.over <= 1) or not entrant.of(None, 1.0).is_installed:
            continue
        kept.score(cell, name, DEFAULT, limit)
        if not best or entrant.at(1) is None:
            continue

        def quality(value: Value, cell: Cell = cell, name: str = name) -> float:
            made = kept.score(cell, name, value, limit)
            return -math.inf if made is None or made.quality is None else made.quality

        first = cell._replace(
            seed=next(other.seed for other in cells if other[:5] == cell[:5] and other.packing == cell.packing)
        )
        if first.seed == cell.seed:
            climb(quality, entrant.at)
        else:
            settled = best_of(kept.of(first, name))
            quality(next((v for v in map(entrant.at, range(-20, 20)) if str(v) == settled), DEFAULT))


def best_of(scores: dict[str, Score]) -> str:
    """The setting of the best quality."""
    return max(scores, key=lambda setting: scores[setting].quality or -math.inf)


def _shown(scores: Sequence[Score]) -> str:
    """Median and range of dB, and medians of the rest."""
    if not (made := [score for score in scores if score.quality is not None]):
        return f"ended at {max(score.seconds for score in scores):.0f} s" if scores else ""
    quality = [score.quality for score in made if score.quality is not None]
    text = f"{statistics.median(quality):.2f}"
    text += f" ({min(quality):.2f} to {max(quality):.2f})" if len(quality) > 1 else ""
    text += f", {statistics.median(score.fraction or 0 for score in made):.2f}"
    text += f", {100 * statistics.median(score.wrong or 0 for score in made):.1f} %"
    for depths in zip(*((score.thin, score.medium, score.thick) for score in made), strict=True):
        if known := [depth for depth in depths if depth is not None]:
            text += f", {statistics.median(known):.2f}"
    seconds = statistics.median(score.seconds for score in made)
    return text + (f", {seconds:.0f} s" if seconds >= 10 else f", {seconds:.2g} s")


def tables(kept: Kept, cells: Sequence[Cell]) -> str:
    """Markdown: a table for each scene, size, width and number of photons; a column for each number of views."""
    lines: list[str] = []
    for cell in dict.fromkeys(c._replace(views=0, seed=0) for c in cells):
        here = [c for c in cells if c._replace(views=0, seed=0) == cell]
        views = list(dict.fromkeys(c.views for c in here))
        where = f"{cell.over:g} times as wide as the field" if cell.over > 1 else "in the field"
        rows: list[str] = []
        for name, best in product(ENTRANTS, (False, True)):
            texts, memory = [], 0.0
            for n in views:
                by_seed = [kept.of(cell, name) for cell in here if cell.views == n]
                # The best setting, for all seeds that have it.
                setting = best_of(by_seed[0]) if best and len(by_seed[0]) > 1 else None if best else DEFAULT
                scores = [one[setting] for one in by_seed if setting in one] if setting else []
                memory = max([memory, *(score.memory for score in scores)])
                named = f" ({ENTRANTS[name].setting} {setting})" if best and scores else ""
                texts.append(_shown(scores) + named)
            if any(texts):
                label = f"{name}, best" if best else name
                rows.append(f"| {label} | " + " | ".join(texts) + f" | {memory:.0f} |")
        if rows:
            packing = f", packing {cell.packing}" if cell.packing else ""
            lines += [f"{cell.scene}{packing}, {cell.columns} x {cell.rows}, {where}, {cell.photons:g} photons:", ""]
            lines += ["| | " + " | ".join(f"{n} views" for n in views) + " | MB |", "|---" * (len(views) + 2) + "|"]
            lines += [*rows, ""]
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scores", type=Path)
    lists = {"scenes": "cathode,packed,cracks,fringes", "columns": "512,1024,2048", "views": "45,90,180"}
    lists |= {"over": "1,1.5", "photons": "1e4,1e5", "seeds": "1,2,3", "packings": "0"}
    lists |= {"of": ",".join(ENTRANTS), "forget": ""}
    for name, default in lists.items():
        parser.add_argument(f"--{name}", default=default, help="parted by commas")
    parser.add_argument("--best", action="store_true", help="the best setting of each, too")
    parser.add_argument("--limit", type=float, default=1800.0, help="CPU seconds of a volume")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="only print what there is")
    asked = parser.parse_args(arguments)
    for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = str(asked.threads)  # of the competitors' processes
    some = {name: [x for x in getattr(asked, name).split(",") if x] for name in lists}
    for names, known in ((some["of"] + some["forget"], ENTRANTS), (some["scenes"], SCENES)):
        if wrong := [name for name in names if name not in known]:
            parser.error(f"there is no {', '.join(wrong)}; there are {', '.join(known)}")
    kinds = {"columns": int, "views": int, "over": float, "photons": float, "seeds": int, "packings": int}
    numbers = [[kind(x) for x in some[name]] for name, kind in kinds.items()]
    cells = [Cell(scene, *values) for scene, *values in product(some["scenes"], *numbers)]
    try:
        kept = Kept(asked.scores)
        if some["forget"]:
            gone = set(some["forget"])
            kept.change(lambda scores: {key: one for key, one in scores.items() if key.split("|")[7] not in gone})
        if not asked.table:
            play_all(kept, cells, some["of"], asked.best, asked.limit)
    except ValueError as error:
        sys.exit(str(error))
    print(tables(kept, cells))


if __name__ == "__main__":
    main(sys.argv[1:])
