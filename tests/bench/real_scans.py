"""The commands and pictures of docs/real_scans.md, from the real scans next to the checkout.

Run from the root of the checkout with  python -m tests.bench.real_scans FOLDER  (some minutes). Volumes and logs stay
in FOLDER. If it exists, only the pictures are drawn again. They are written to docs/.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from beamline.storage.volume_file import read_volume

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"
WALNUT = "walnut_parallel_rebinned_240x96x256.h5 --quantity line-integrals --views fixed:60"


@dataclass(frozen=True)
class Shown:
    """Two volumes of a scan, before and after, and the displayed parts of one slice.

    Attributes:
        before, after: commands; their outputs are named after -o.
        titles: titles of the two volumes.
        slice: number of the slice.
        windows: a grey window for each part.
        parts: rows and columns (first, end) of each part.
    """

    before: str
    after: str
    titles: tuple[str, str]
    slice: int
    windows: tuple[tuple[float, float], ...]
    parts: tuple[tuple[int, int, int, int], ...]


SCANS = {
    "diamond": Shown(
        "beamline recon diamond_24737_parallel_91x135x160.h5 -m fbp -o diamond_fbp.h5",
        "beamline recon diamond_24737_parallel_91x135x160.h5 -m r2 --rings vo -o diamond_r2.h5",
        ("FBP", "R²-Gaussian, --rings vo"),
        70,
        ((-0.001, 0.0045), (-0.001, 0.0045)),
        ((0, 160, 0, 160), (60, 130, 45, 115)),
    ),
    "dome": Shown(
        "beamline recon diamond_24737_parallel_91x135x160.h5 -m fista-tv --air columns -o dome_columns.h5",
        "beamline recon diamond_24737_parallel_91x135x160.h5 -m fista-tv -o dome.h5",
        ("FISTA-TV, --air columns", "FISTA-TV"),
        60,
        ((-0.0007, 0.0028), (-0.0007, 0.0028)),
        ((0, 160, 0, 160), (30, 130, 20, 120)),
    ),
    "tooth": Shown(
        "beamline recon aps2bm_tooth_181x2x640.h5 -m fbp -o tooth_fbp.h5",
        "beamline recon aps2bm_tooth_181x2x640.h5 -m r2 --rings vo -o tooth_r2.h5",
        ("FBP", "R²-Gaussian, --rings vo"),
        0,
        ((-0.001, 0.0095), (-0.001, 0.0095)),
        ((160, 480, 160, 480), (270, 350, 330, 430)),
    ),
    "walnut": Shown(
        f"beamline recon {WALNUT} --truth walnut_fdk_256.npz:70:166 -m fbp -o walnut_fbp.h5",
        f"beamline recon {WALNUT} --truth walnut_fdk_256.npz:70:166 -m r2 -o walnut_r2.h5",
        ("FBP, 60 views", "R²-Gaussian, 60 views"),
        48,
        ((-0.01, 0.07), (-0.01, 0.07)),
        ((0, 256, 0, 256), (80, 160, 80, 180)),
    ),
}
FURTHER = ("beamline recon diamond_24737_tiff_series.zip --angle-rows 10:101 -m fbp -o tiffs_fbp.h5",)


def run(folder: Path) -> None:
    """Run every command in `folder`, with links to the scans; seconds and output of each go to log.txt."""
    folder.mkdir()
    for path in DATA.iterdir():
        if path.suffix in (".h5", ".npz", ".zip"):
            (folder / path.name).symlink_to(path)
    with (folder / "log.txt").open("w", encoding="utf-8") as log:
        for command in [c for shown in SCANS.values() for c in (shown.before, shown.after)] + list(FURTHER):
            begin = time.monotonic()
            words = [sys.executable, "-m", "beamline.cli.main", *shlex.split(command)[1:]]
            ended = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=True, encoding="utf-8")
            log.write(f"$ {command}\n{ended.stderr}{ended.stdout}{time.monotonic() - begin:.0f} s\n\n")
            log.flush()


def picture(shown: Shown, folder: Path, path: Path) -> None:
    """The parts of the slice side by side, before above after, each in its grey window."""
    figure = Figure(figsize=(8.4, 8.4), dpi=80, layout="constrained")
    for row, (command, title) in enumerate(zip((shown.before, shown.after), shown.titles, strict=True)):
        volume, _ = read_volume(folder / command.split(" -o ")[1])
        data = np.asarray(volume[shown.slice])
        for column, (part, (low, high)) in enumerate(zip(shown.parts, shown.windows, strict=True)):
            axes = figure.add_subplot(2, len(shown.parts), 1 + row * len(shown.parts) + column)
            top, bottom, left, right = part
            axes.imshow(
                data[top:bottom, left:right],
                cmap="gray",
                vmin=low,
                vmax=high,
                extent=(left - 0.5, right - 0.5, bottom - 0.5, top - 0.5),
                interpolation="nearest",
            )
            axes.set_title(f"{title}, slice {shown.slice}", fontsize=9)
            axes.tick_params(labelsize=7)
    figure.savefig(path, pil_kwargs={"quality": 80})


if __name__ == "__main__":
    target = Path(sys.argv[1])
    if not target.exists():
        run(target)
    for name, scan in SCANS.items():
        picture(scan, target, ROOT / "docs" / f"real_scans_{name}.jpg")
