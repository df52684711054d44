"""Clean scans: 240 of many kinds, run through all judgements of a reconstruction and of `info`.

python -m tests.bench.clean_scans [FIRST [STOP]] prints every warning. It ends with exit code 1 if no property of the
scan explains a warning (few projections, a sample wider than the field of view and so on; see EXPLAINED).
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.features.files.validate import source_findings
from beamline.projections.selection import Selection
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.evidence import ScanEvidence
from tests.beamline.array_source import ArraySource
from tests.beamline.prepared_views import prepare

COUNT = 240
VIEWS = 2, 5, 12, 30, 45, 60, 90, 90, 120, 180, 360, 720
EXPLAINED = {
    "wide": r"beyond the field|wider than the field|continues? beyond|no detector column shows air|leaves the field",
    "few": r"limited angle|not a clear optimum|was not found|fewer than|at least|only",
    "exposed": r"The projections were exposed for|he darks were exposed for",
    "faint": r"transmit less than the smallest|leaves the field|The projections show no sample|zingers|dead or hot|"
    r"All darks are 0|locally brighter than the flats",
    "cone": r"rotation axis",
    "always": r"got no beam or is saturated|dead or hot|zingers",
}

Change = Callable[[float, NDArray[np.float64]], NDArray[np.float64]]


def lines_of(
    balls: NDArray[np.float64], angles: NDArray[np.float64], shape: tuple[int, int], axis_col: float,
    sod: float | None = None, change: Change = lambda t, balls: balls,
) -> NDArray[np.float64]:  # fmt: skip
    """Line integrals [view, row, col] of balls (x, y, z, radius, density), in pixels at the axis, by exact chords.

    Args:
        sod: distance from source to axis, of a cone; the detector is at twice that distance, with pixels of 2.
        change: function that gives the balls at a time from 0 to 1.
    """
    u, v = np.meshgrid(np.arange(shape[1]) - axis_col, np.arange(shape[0]) - (shape[0] - 1) / 2)
    out = np.zeros((angles.size, *shape))
    norm = 1.0 if sod is None else np.sqrt(u**2 + v**2 + sod**2)
    for i, angle in enumerate(angles):
        for x, y, z, r, mu in change(i / max(angles.size - 1, 1), balls):
            a, b = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
            if sod is None:
                off = (u - a) ** 2 + (v - z) ** 2
            else:
                off = a**2 + (sod + b) ** 2 + z**2 - ((a * u + (sod + b) * sod + z * v) / norm) ** 2
            out[i] += 2 * mu * np.sqrt(np.clip(r * r - off, 0, None))
    return out


def clean_scan(seed: int, change: Change = lambda t, balls: balls, **fixed: object) -> tuple[ArraySource, set[str]]:
    """A scan of a random kind without faults, and the properties that explain messages about it."""
    rng = np.random.default_rng(seed)
    kind: dict[str, Any] = {
        "turns": 1,
        "views": int(rng.choice(VIEWS)), "rows": int(rng.integers(6, 26)), "cols": int(rng.integers(48, 97)),
        "beam": str(rng.choice(["half", "half", "full", "cone"])), "wide": rng.random() < 0.25,
        "depth": float(rng.choice([0.1, 1.0, 1.5, 2.5, 5.0])), "light": float(10 ** rng.uniform(2.0, 4.7)),
        "order": str(rng.choice(["even", "even", "even", "passes", "random", "repeated"])),
        "written": str(rng.choice(["counts"] * 8 + ["float", "share", "full scale"])),
        "exposed": rng.random() < 0.1, "groups": int(rng.integers(1, 4)), "rings": rng.random() < 0.3,
        "drift": float(rng.uniform(-0.08, 0.05)), "harden": float(rng.uniform(0, 0.1)),
        "count": int(rng.integers(2, 16)),
        **fixed,
    }  # fmt: skip
    kind["exposed"] = bool(kind["exposed"]) and kind["written"] in ("counts", "float")
    n, shape = kind["views"], (kind["rows"], kind["cols"])
    kind["order"] = "even" if n < 12 else kind["order"]
    turn = (np.pi if kind["beam"] == "half" else 2 * np.pi) * kind["turns"]
    angles = np.linspace(0, turn, n, endpoint=False)
    if kind["order"] == "passes":
        angles = np.concatenate([angles[::2], angles[1::2]])
    elif kind["order"] == "random":
        angles = rng.permutation(angles)
    elif kind["order"] == "repeated":
        angles = np.repeat(angles[:: (k := int(rng.choice([2, 3, 5])))], k)[:n]
    axis, half = shape[1] / 2 + rng.uniform(-2, 2), shape[1] / 2
    turn, away = rng.uniform(0, 2 * np.pi, kind["count"]), 0.55 * half * np.sqrt(rng.uniform(0, 1, kind["count"]))
    heights, radii = rng.uniform(-0.4, 0.4, kind["count"]) * shape[0], rng.uniform(0.08, 0.24, kind["count"]) * half
    densities = rng.uniform(0.3, 1, kind["count"])
    balls = np.stack([away * np.cos(turn), away * np.sin(turn), heights, radii, densities], axis=1)
    if rng.random() < 0.5:
        balls = np.concatenate([balls, [(0, 0, 0, 0.7 * half, 0.2)]])
    if kind["wide"]:
        balls = np.concatenate([balls, [(0, 0, 0, rng.uniform(1.4, 2.5) * half, 0.4)]])
    lines = lines_of(balls, angles, shape, axis, 6 * half if kind["beam"] == "cone" else None, change)
    lines *= kind["depth"] / max(lines.max(), 1e-9)
    lines *= 1 - kind["harden"] * lines / lines.max()
    profile = np.exp(-((np.linspace(-1, 1, shape[1]) * rng.uniform(0, 0.8)) ** 2))[None] * np.ones(shape)
    if kind["rings"]:
        profile = profile * rng.normal(1, 0.02, shape)
    light = np.linspace(1, 1 + kind["drift"], n)
    seconds = rng.choice([0.1, 0.2], n) if kind["exposed"] else np.full(n, 0.1)
    open_beam = kind["light"] * profile
    views = rng.poisson(open_beam * (light * seconds / 0.1)[:, None, None] * np.exp(-lines))
    at = [0, n, n // 2][: kind["groups"]]
    groups = {i: rng.poisson(open_beam * (light[min(i, n - 1)]), (int(rng.integers(2, 9)), *shape)) for i in at}
    dark = 100.0 if kind["light"] > 300 else 0.0
    frames, keys, exposures, stated = [np.zeros((5, *shape))], [2] * 5, [np.full(5, 0.1)], [np.full(5, np.nan)]
    for i in sorted(at):
        frames += [groups[i]]
        keys += [1] * len(groups[i])
        exposures, stated = [*exposures, np.full(len(groups[i]), 0.1)], [*stated, np.full(len(groups[i]), np.nan)]
        stop = min([j for j in at if j > i], default=n)
        frames, keys = [*frames, views[i:stop]], keys + [0] * (stop - i)
        exposures, stated = [*exposures, seconds[i:stop]], [*stated, angles[i:stop]]
    data = np.concatenate(frames).astype(np.float64) + dark
    data += rng.normal(0, 1.5, data.shape) if dark else 0
    if kind["written"] in ("share", "full scale"):
        key = np.array(keys)
        flat = data[key == 1].mean(axis=0) - dark
        data = (data - dark) / flat
        data[key == 2], data[key == 1] = 0, 1
        data = data.astype(np.float32) if kind["written"] == "share" else (data * 65535).round().clip(0, 65535)
    dtype = np.float32 if kind["written"] in ("float", "share") else np.uint16
    data = data if dtype is np.float32 else data.round().clip(0, 65535)
    source = ArraySource(
        data.astype(dtype), keys, np.concatenate(stated), np.concatenate(exposures) if kind["exposed"] else None
    )
    source.axis_col = axis
    if kind["beam"] == "cone":
        source.cone, source.pixel_size_mm = (6 * half * 0.001, 12 * half * 0.001), 0.002
    why = {"always", *(name for name in ("wide", "exposed") if kind[name])}
    directions = n // (2 if kind["beam"] == "full" and n % 2 == 0 else 1)  # opposite directions are the same
    why |= {"few"} if directions < 30 or kind["order"] == "repeated" else set()
    why |= {"faint"} if kind["depth"] < 0.5 or kind["depth"] > 3 or kind["light"] < 300 else set()
    return source, why | {str(kind)}


def told_of(source: ArraySource) -> list[str]:
    """The messages of a reconstruction, `validate` and `info` about a scan, without those that every scan gets."""
    told = [
        finding.message
        for finding in source_findings(ScanEvidence(cast(ScanSource, source)))
        if finding.severity != "info"
    ]
    try:
        told += prepare(source, Selection(axis_col=source.axis_col))[1]
    except DataError as error:
        told.append(f"refused: {error}")
    return list(dict.fromkeys(str(sentence) for sentence in told))


def unexplained(source: ArraySource, why: set[str]) -> list[str]:
    known = "|".join(EXPLAINED[name] for name in why if name in EXPLAINED)
    return [sentence for sentence in told_of(source) if not re.search(known, sentence)]


def main() -> int:
    """Print the messages about each scan."""
    first, stop = [*map(int, sys.argv[1:]), 0, COUNT][:2] if len(sys.argv) < 3 else map(int, sys.argv[1:3])
    wrong = 0
    for seed in range(first, stop):
        source, why = clean_scan(seed)
        if said := unexplained(source, why):
            wrong += 1
            print(seed, max(why, key=len))
            for sentence in said:
                print("   ", sentence)
    print(f"{wrong} of {stop - first} clean scans with an unexplained message")
    return wrong > 0


if __name__ == "__main__":
    sys.exit(main())
