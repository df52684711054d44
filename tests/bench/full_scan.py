"""Makes a scan of full size and measures the quality of its volume.

    python tests/bench/full_scan.py make FOLDER [SIDE VIEWS]
    beamline recon FOLDER/scan.tif -m fbp --quantity line-integrals --angles FOLDER/angles.txt --axis C ...
    python tests/bench/full_scan.py judge FOLDER VOLUME.h5

The scan is one BigTIFF of float32 line integrals, 1800 x 2048 x 2048: 30 GB, sparse on disk. Three bands of rows show
ellipsoids in a cylinder; the other rows are holes in the sparse file, which read as zeros.
"""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import numpy as np
import tifffile

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid

BAND = 16  # rows


def bands(side: int) -> list[slice]:
    """Rows at the lower end, in the middle and at the upper end."""
    return [slice(first, first + BAND) for first in (0, side // 2 - BAND // 2, side - BAND)]


def sample(side: int) -> Phantom:
    """The same in each band, in pixels around its middle: grains in a cylinder."""
    rng = np.random.default_rng(0)
    places = zip(0.35 * side * np.sqrt(rng.random(40)), rng.uniform(0, 2 * np.pi, 40), strict=True)
    sizes = rng.uniform(side / 400, side / 40, (40, 3))
    grains = [
        Ellipsoid((a, b, c), 0.004, centre=(r * np.cos(t), r * np.sin(t), 0.0))
        for (a, b, c), (r, t) in zip(sizes, places, strict=True)
    ]
    return Phantom.of((Cylinder(0.45 * side, 4.0 * BAND, 0.001), *grains))


def make(folder: Path, side: int = 2048, views: int = 1800) -> None:
    folder.mkdir()
    angles = np.arange(views) * 180.0 / views
    np.savetxt(folder / "angles.txt", angles)
    scan = tifffile.memmap(folder / "scan.tif", shape=(views, side, side), dtype=np.float32, bigtiff=True)
    phantom, detector = sample(side), Detector.centred((BAND, side), 1.0)
    for view, angle in enumerate(np.deg2rad(angles)):
        image = phantom.line_integrals(float(angle), detector)
        for rows in bands(side):
            scan[view, rows] = image
        if view % 100 == 99:
            print(f"{view + 1}/{views} views", flush=True)
    scan.flush()


def judge(folder: Path, volume: Path) -> None:
    """Print the RMS error in each band as a share of a grain's density, and the largest value between the bands."""
    with h5py.File(volume) as file:
        data = file["entry/data/data"]
        side = data.shape[0]
        grid = Grid.matching(Geometry.parallel(np.zeros(1), (BAND, data.shape[2]), pixel_pitch=1.0))
        truth = sample(side).attenuation(grid)
        for rows in bands(side):
            error = float(np.sqrt(np.mean((data[rows] - truth) ** 2)))
            print(f"slices {rows.start}:{rows.stop}: error {error / 0.005:.4f} of a grain's density")
        between = max(float(np.abs(data[z]).max()) for z in range(BAND + 4, side // 2 - BAND, side // 16))
        print(f"between the bands at most {between / 0.005:.1e}")


if __name__ == "__main__":
    _, verb, folder, *more = sys.argv
    if verb == "make":
        make(Path(folder), *map(int, more))
    else:
        judge(Path(folder), Path(more[0]))
