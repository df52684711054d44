"""Whole commands by detector width: CPU and wall seconds per slice, peak and planned memory, PSNR.

    python tests/bench/size_table.py FOLDER METHOD COLUMNS [ROWS VIEWS LIMIT OPTION ...]

The scan is one TIFF of line integrals of grains in a cylinder, with the noise of 10 000 photons. A warm-up with 64
columns compiles the kernels. A command that takes longer than LIMIT seconds (600) is ended. OPTIONs are passed to
`recon`.
"""

from __future__ import annotations

import json
import math
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tifffile

from beamline.storage.writers.recon_file import read_reconstruction
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid

_PHOTONS = 1e4
_MEMORY = "16G"


def sample_of(cols: int, rows: int) -> Phantom:
    """Grains in a cylinder, in pixels; a path through the middle of the cylinder has a line integral of 1.5."""
    rng, side = np.random.default_rng(0), float(cols)
    places = zip(0.4 * side * np.sqrt(rng.random(200)), rng.uniform(0, 2 * np.pi, 200), strict=True)
    grains = [
        Ellipsoid(tuple(size), 2.0 / side, centre=(r * np.cos(t), r * np.sin(t), z))
        for (r, t), size, z in zip(
            places, rng.uniform(side / 200, side / 25, (200, 3)), rng.uniform(-rows / 2, rows / 2, 200), strict=True
        )
    ]
    return Phantom.of((Cylinder(0.45 * side, 4.0 * rows, 1.5 / (0.9 * side)), *grains))


def make(path: Path, cols: int, rows: int, views: int) -> None:
    """The scan."""
    rng, sample = np.random.default_rng(1), sample_of(cols, rows)
    scan = np.empty((views, rows, cols), np.float32)
    for view, angle in enumerate(np.pi * np.arange(views) / views):
        integrals = sample.line_integrals(float(angle), Detector.centred((rows, cols), 1.0))
        photons = np.maximum(rng.poisson(_PHOTONS * np.exp(-integrals)), 1)
        scan[view] = -np.log(photons / _PHOTONS)
    tifffile.imwrite(path, scan)
    np.savetxt(path.with_suffix(".txt"), 180.0 * np.arange(views) / views)


def command(path: Path, method: str, cols: int, *more: str) -> list[str]:
    options = ("--quantity", "line-integrals", "--angles", str(path.with_suffix(".txt")), "--axis", str((cols - 1) / 2))
    output = ("--no-report", "--memory", _MEMORY, "-o", str(path.with_suffix(f".{method}.h5")))
    return [sys.executable, "-m", "beamline.cli.main", "recon", str(path), "-m", method, *options, *output, *more]


def quality(path: Path, sample: Phantom) -> float:
    """PSNR of a volume in dB, with the largest value of the ground truth as peak; computed slice by slice."""
    volume = read_reconstruction(path).volume
    squares, peak = 0.0, 0.0
    for z in range(volume.grid.shape[0]):
        whole = (slice(0, n) for n in volume.grid.shape[1:])
        truth = sample.attenuation(volume.grid.part(slice(z, z + 1), *whole))
        squares += float(np.square(volume.data[z] - truth[0], dtype=np.float64).sum())
        peak = max(peak, float(truth.max()))
    return 10 * math.log10(peak**2 * volume.data.size / squares)


def measure(
    folder: Path, method: str, cols: int, rows: int = 64, views: int = 90, limit: int = 600, *, more: Sequence[str] = ()
) -> None:
    small, path = folder / "warm.tif", folder / f"{cols}x{rows}x{views}.tif"
    for scan, size in ((small, (64, 16, 24)), (path, (cols, rows, views))):
        if not scan.exists():
            make(scan, *size)
    subprocess.run(command(small, method, 64), check=True, capture_output=True)
    small.with_suffix(f".{method}.h5").unlink()
    said = subprocess.run(
        command(path, method, cols, "--dry-run", "--json"), check=True, capture_output=True, text=True
    )
    plan = json.loads(said.stdout.splitlines()[-1])
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    try:
        subprocess.run(command(path, method, cols, *more), check=True, capture_output=True, timeout=limit)
    except subprocess.TimeoutExpired:
        print(f"{method}, {cols} columns: more than {limit} s", flush=True)
        return
    wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(
        f"{method}, {views} views of {rows} x {cols}: {busy / rows:.3f} CPU s and {wall / rows:.3f} s a slice "
        f"({busy / (rows * cols**2 * views) * 1e9:.1f} CPU ns a voxel and view), peak {after.ru_maxrss / 1e6:.2f} GB "
        f"with the program, {plan['memory'] / 1e9:.2f} planned, {plan['seconds']:.0f} s expected, "
        f"{quality(path.with_suffix(f'.{method}.h5'), sample_of(cols, rows)):.2f} dB {' '.join(more)}",
        flush=True,
    )
    path.with_suffix(f".{method}.h5").unlink()


if __name__ == "__main__":
    _, where, name, *rest = sys.argv
    Path(where).mkdir(exist_ok=True)
    measure(Path(where), name, *map(int, rest[:4]), more=rest[4:])
