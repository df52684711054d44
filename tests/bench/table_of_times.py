"""Start-up times: a table of whole commands, several runs of each checkout in turn.

    python tests/bench/table_of_times.py FOLDER [CHECKOUT ...] [--runs 5] [--only WORD] [--only WORD]

FOLDER is for scans, environments and results; measured scans come from ../shared/data next to this checkout. Each row
is run once with every checkout (this one if none is named), then again, so that a busy minute affects all of them.
Times are in s from the start of the command: the median, and in brackets the smallest and the largest. The first run of
a row is left out, because it compiles, unless the row is about a first run. A row "by level" is run for each level of
x86-64 that the processor supports. Quiet machine, two cores: nothing else may run.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
import venv
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from recon.compiled import LEVELS, level_for, processor_flags

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"
BIN = "Scripts" if os.name == "nt" else "bin"
FIVE = {
    "diamond": ("diamond_24737_parallel_91x135x160.h5",),
    "tooth": ("aps2bm_tooth_181x2x640.h5",),
    "walnut": ("walnut_parallel_rebinned_240x96x256.h5", "--views", "every:4", "--quantity", "line-integrals"),
    "grains": ("grains_128x16x50.tif", "--quantity", "line-integrals", "--angles", "grains_128x16x50.txt"),
    "grains, 256 columns": ("grains_256x16x90.tif", "--quantity", "line-integrals", "--angles", "grains_256x16x90.txt"),
}


@dataclass(frozen=True)
class Row:
    """A command and the moments in it that are timed.

    Attributes:
        words: arguments of `beamline`, or of pip if `install` is set.
        moments: names of events whose first time is measured; "word" is the first output of any kind.
        new: True: newly installed packages, with only the compiled code that they contain.
        first_run: True: no kernel is compiled or included.
        by_level: True: run once for each level of x86-64.
        refused: True: the command ends with an error.
    """

    name: str
    words: tuple[str, ...]
    moments: tuple[str, ...] = ()
    new: bool = False
    first_run: bool = False
    by_level: bool = False
    refused: bool = False
    install: bool = False


def rows() -> Iterator[Row]:
    demo = "demo", "--json", "-o"
    large = (
        "grains_512x128x180.tif", "--quantity", "line-integrals",
        "--angles", "grains_512x128x180.txt", "--pixel-size-um", "10",
    )  # fmt: skip
    yield Row("pip install", (), install=True)
    yield Row("demo, the first command", (*demo, "demo"), ("word", "frame", "slices"), new=True)
    yield Row("demo, no kernel compiled or carried", (*demo, "demo"), ("word", "frame", "slices"), first_run=True)
    yield Row("demo", (*demo, "demo"), ("word", "frame", "slices"))
    yield Row("recon of a missing scan", ("recon", "missing.h5"), ("word",), refused=True)
    yield Row("scan of a missing configuration", ("scan", "missing.yaml"), ("word",), refused=True)
    yield Row("fbp, 128 x 512, 180 views", ("recon", *large, "-m", "fbp", "-o", "out.h5"), ("word",), by_level=True)
    yield Row("the same without a report", ("recon", *large, "-m", "fbp", "--no-report", "-o", "out.h5"), ("word",))
    for name, words in FIVE.items():
        yield Row(f"recon, {name}", ("recon", *words, "--no-report", "-o", "out.h5"), ("word",), by_level=True)


@dataclass
class Times:
    """Seconds of each run, by what was measured: the whole, its processor time, moments."""

    of: dict[str, list[float]] = field(default_factory=dict)

    def add(self, run: Mapping[str, float]) -> None:
        for name, seconds in run.items():
            self.of.setdefault(name, []).append(seconds)

    def text(self, name: str) -> str:
        if not (seconds := self.of.get(name)):
            return ""
        return f"{statistics.median(seconds):.1f} ({min(seconds):.1f} to {max(seconds):.1f})"


def measured(row: Row, checkout: Path, folder: Path, level: Mapping[str, str]) -> dict[str, float]:
    """One run."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "PYTHONUNBUFFERED": "1", **level}
    for output in folder.glob("out*"):
        output.unlink()
    shutil.rmtree(folder / "demo", ignore_errors=True)
    words = [sys.executable, "-m", "beamline.cli.main", *row.words]
    if row.first_run:
        shutil.rmtree(folder / "kernels", ignore_errors=True)
        environment["NUMBA_CACHE_DIR"] = str(folder / "kernels")
    if row.new:
        shutil.rmtree(folder / "packages", ignore_errors=True)
        for package in ("beamline", "configs", "drivers", "recon", "simulators"):
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(checkout / package, folder / "packages" / package, ignore=ignored)
        shutil.copy(checkout / "pyproject.toml", folder / "packages")
        environment["PYTHONPATH"] = str(folder / "packages")
    if row.install:
        shutil.rmtree(folder / "environment", ignore_errors=True)
        venv.create(folder / "environment", with_pip=True)
        python = folder / "environment" / BIN / "python"
        words = [str(python), "-m", "pip", "install", "-q", "--no-compile", "-c", str(checkout / "constraints.txt")]
        words.append(str(checkout))
        del environment["PYTHONPATH"]
    before, begin, clock = os.times(), time.perf_counter(), time.time()
    process = subprocess.Popen(
        words, cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    found: dict[str, float] = {}
    assert process.stdout is not None
    with process.stdout as lines:
        for line in lines:
            if line.strip():
                found.setdefault("word", time.perf_counter() - begin)
            if line.startswith("{"):
                event = json.loads(line)
                found.setdefault(event["event"], event["time"] - clock)
    failed, seconds, after = process.wait(), time.perf_counter() - begin, os.times()
    if bool(failed) != row.refused:
        raise RuntimeError(f"{row.name}: exit code {failed}")
    busy = after.children_user + after.children_system - before.children_user - before.children_system
    return {"whole": seconds, "processor": busy, **{name: found[name] for name in row.moments if name in found}}


def make_scans(folder: Path) -> None:
    """Those that are simulated, and links to the measured ones."""
    from tests.bench.size_table import make

    for cols, detector_rows, views in ((512, 128, 180), (128, 16, 50), (256, 16, 90)):
        if not (path := folder / f"grains_{cols}x{detector_rows}x{views}.tif").exists():
            make(path, cols, detector_rows, views)
    for words in FIVE.values():
        if (DATA / words[0]).is_file() and not (folder / words[0]).exists():
            (folder / words[0]).symlink_to(DATA / words[0])


def table(wanted: Callable[[Row], bool], checkouts: list[Path], folder: Path, runs: int) -> Iterator[str]:
    """Lines of Markdown."""
    best = level_for({}, processor_flags())
    levels = LEVELS[LEVELS.index(best) :] if best in LEVELS else ()
    yield "| | checkout | level | whole | processor s | first word | first frame | first slices |"
    yield "|---|---|---|---|---|---|---|---|"
    for row in filter(wanted, rows()):
        kinds = [(level.name, level.environment) for level in levels] if row.by_level else [("", {})]
        times = {(checkout, name): Times() for checkout in checkouts for name, _ in kinds}
        first_counts = row.new or row.first_run or row.install
        for run in range(runs + (not first_counts)):
            for name, environment in kinds:
                for checkout in checkouts:
                    seconds = measured(row, checkout, folder, environment)
                    if run or first_counts:
                        times[checkout, name].add(seconds)
        for (checkout, name), of in times.items():
            cells = [of.text(column) for column in ("whole", "processor", "word", "frame", "slices")]
            yield f"| {row.name} | {checkout.name} | {name} | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("checkouts", type=Path, nargs="*", default=[ROOT])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--only", action="append", default=[], help="rows whose name has one of these words")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    make_scans(given.folder)
    checkouts = [checkout.resolve() for checkout in given.checkouts]
    for line in table(
        lambda row: not given.only or any(word in row.name for word in given.only),
        checkouts, given.folder.resolve(), given.runs,
    ):  # fmt: skip
        print(line, flush=True)


if __name__ == "__main__":
    main()
