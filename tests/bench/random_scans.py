"""Random scans by `beamline recon -m fbp`: refusals, warnings, and how far volumes are from the truth.

python -m tests.bench.random_scans [FIRST:END] prints a line for each scan that was refused or warned of, or whose
volume is off, and a table of sentences. All scans are sound: what is refused or warned of is a false alarm, unless the
sample goes on beyond the field, which is said.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import tifffile
from click.testing import CliRunner
from numpy.typing import NDArray

from beamline.cli.main import main
from drivers.base.frame import FrameKind
from simulators.frame.mapping import SceneError
from simulators.scenes.expose import Scan, expose
from simulators.scenes.scene import load_scene

PITCH = 4.6  # um
WIDE = 1.3  # of the field: the share of samples that fill it
LAYOUTS = "nxtomo", "exchange", "tiffs", "stacks", "plain"


@dataclass(frozen=True, eq=False)
class RandomScan:
    """Frames of a sound scan as a camera gives them, by its seed.

    Attributes:
        frames, keys, angles: counts [frame, row, col], kinds and degrees; darks, flats, views, flats.
        wide: the sample fills the field.
        about: what is random, for the report.
        truth: attenuation [z, y, x] in 1/mm, coarse; the middle slice.
    """

    frames: NDArray[np.uint16]
    keys: NDArray[np.int32]
    angles: NDArray[np.float64]
    wide: bool
    about: dict[str, Any]
    axis_col: float
    lines: NDArray[np.float64]


def random_scan(seed: int) -> RandomScan:
    """Size, noise, sample, effects, order and turn are random."""
    rng = np.random.default_rng(seed)
    shape = int(rng.integers(8, 28)), int(rng.integers(56, 112))
    wide = bool(rng.random() < 0.15)
    views = int(rng.integers(60, 140))
    turn = float(rng.choice([180.0, 360.0])) * float(rng.choice([1, -1], p=[0.8, 0.2]))
    photons = float(10 ** rng.uniform(2.6, 3.75))
    about = {"shape": shape, "views": views, "turn": turn, "photons": photons, "wide": wide}
    phantom = _phantom(rng, shape, wide, about)
    effects = _effects(rng, about, LAYOUTS[seed % len(LAYOUTS)] == "plain")
    offset = float(rng.uniform(-3, 3)) if turn in (180.0, -180.0) or not wide else 0.0
    scene = load_scene(
        {
            "phantom": phantom,
            "beam": {"photons_per_s": photons / 0.05},
            "axis_offset_px": offset,
            "detector": {"shape": list(shape), "pixel_size_um": PITCH, "exposure_s": 0.05},
            "scan": {
                "views": views,
                "range_deg": turn,
                "period_s": 0.1,
                "darks": int(rng.integers(3, 12)),
                "flats": int(rng.integers(3, 16)),
            },
            "effects": effects,
        }
    )
    scan = Scan.of(scene, seed)
    planned = list(scan)
    if rng.random() < 0.15:
        still = [each for each in planned if each.kind is not FrameKind.PROJECTION]
        seen = [each for each in planned if each.kind is FrameKind.PROJECTION]
        planned = still + [seen[at] for at in rng.permutation(len(seen))]
        about["shuffled"] = True
    frames = np.stack([expose(scene, each.shot) for each in planned])
    keys = np.array([_KEY[each.kind] for each in planned], np.int32)
    angles = np.array([np.degrees(each.shot.angle) for each in planned]) + float(
        rng.choice([0.0, rng.uniform(-90, 90)])
    )
    lines = np.stack(
        [
            scene.sample.line_integrals(np.full(shape[0], each.shot.angle), each.shot.detector)
            for each in planned[:: max(1, len(planned) // 16)]
        ]
    )
    about["deepest"] = float(lines.max())
    return RandomScan(frames, keys, angles, wide, about, scan.detector.axis_col, lines)


_KEY = {FrameKind.PROJECTION: 0, FrameKind.FLAT: 1, FrameKind.DARK: 2}


def _phantom(rng: np.random.Generator, shape: tuple[int, int], wide: bool, about: dict[str, Any]) -> dict[str, Any]:
    width = shape[1] * PITCH * 1e-3 * (WIDE if wide else float(rng.uniform(0.5, 0.9)))
    height = shape[0] * PITCH * 1e-3 * float(rng.choice([3.0, rng.uniform(0.5, 0.9)]))
    deep = float(rng.uniform(0.4, 2.5))
    kind = str(rng.choice(["foam", "battery", "solids", "solids"]))
    about["phantom"], about["height"] = kind, height / (shape[0] * PITCH * 1e-3)
    if kind == "foam":
        sizes = {"n_holes": int(rng.integers(20, 200)), "largest_um": width * 150, "smallest_um": width * 30}
        seed = int(rng.integers(1000))
        return {"kind": "foam", "diameter": width, "height": height, **sizes, "gap_um": 1.0,
                "attenuation": {"matter": deep / width}, "seed": seed}  # fmt: skip
    if kind == "battery":
        field = [width / 0.88, max(height, width / 2)]
        few, seed = int(rng.integers(4, 30)), int(rng.integers(1000))
        return {"kind": "battery", "field_of_view": field, "n_particles": few, "fill": 0.1, "seed": seed}
    solids: list[dict[str, Any]] = []
    if wide or rng.random() < 0.5:
        solids.append({"kind": "cylinder", "radius": width / 2, "height": height, "attenuation": deep / 2 / width})
    for _ in range(int(rng.integers(1, 20))):
        size, out, turn = width * rng.uniform(0.03, 0.15), width * 0.33 * rng.random() ** 0.5, rng.uniform(0, 2 * np.pi)
        centre = [
            out * np.cos(turn),
            out * np.sin(turn),
            float(rng.uniform(-0.4, 0.4)) * min(height, shape[0] * PITCH * 1e-3),
        ]
        solid = str(rng.choice(["ellipsoid", "box", "cylinder"]))
        edges = {
            "ellipsoid": {"semi_axes": (size * rng.uniform(0.5, 1, 3)).tolist()},
            "box": {"edges": (2 * size * rng.uniform(0.5, 1, 3)).tolist()},
            "cylinder": {"radius": float(size), "height": float(2 * size)},
        }[solid]
        solids.append(
            {"kind": solid, **edges, "attenuation": deep / 4 / float(size), "centre": [float(c) for c in centre]}
        )
    return {"kind": "solids", "solids": solids}


def _effects(rng: np.random.Generator, about: dict[str, Any], steady: bool) -> list[Any]:
    """Those of any beamline; a steady beam, where frames are given divided by one flat."""
    some = [
        ("runout", {"kind": "runout", "radial_random_um": PITCH * 0.1}),
        ("hard", {"kind": "beam_hardening", "weights": [1, 1, 1], "ratios": [0.8, 1.0, 1.25]}),
        ("profile", {"kind": "beam_profile", "sigma": [1.6, 0.8], "stripes": 0.03, "drift": 2.0e-5}),
        ("ring", {"kind": "ring_current", "lifetime": float(rng.uniform(100, 2000))}),
        ("prnu", {"kind": "prnu", "spread": 0.03}),
        ("noise", "photon_noise"),
        ("dark", {"kind": "dark_current", "rate": 50.0}),
        ("hot", {"kind": "hot_pixels", "fraction": 1e-3, "rate": 20000.0}),
        ("zingers", {"kind": "zingers", "rate": float(rng.uniform(1, 20))}),
        ("dead", {"kind": "dead_pixels", "fraction": 2e-4}),
        ("read", {"kind": "read_noise", "rms": float(rng.uniform(0.5, 5))}),
    ]  # fmt: skip
    chosen = [
        each
        for each in some
        if each[0] == "noise" or (rng.random() < 0.35 and not (steady and each[0] in ("ring", "profile", "dead")))
    ]
    about["effects"] = [name for name, _ in chosen]
    return [*(effect for _, effect in chosen), "offset"]


def written(scan: RandomScan, layout: str, folder: Path, rng: np.random.Generator) -> list[str]:
    """The scan in a layout; arguments of the command."""
    dark, flat, view = (scan.frames[scan.keys == key] for key in (2, 1, 0))
    theta = scan.angles[scan.keys == 0]
    if layout == "nxtomo":
        with h5py.File(folder / "scan.nxs", "w") as file:
            entry = file.create_group("entry")
            entry.attrs["NX_class"], entry["definition"] = "NXentry", "NXtomo"
            detector = entry.create_group("instrument/detector")
            entry["instrument"].attrs["NX_class"], detector.attrs["NX_class"] = "NXinstrument", "NXdetector"
            detector["data"], detector["image_key"] = scan.frames, scan.keys
            detector["x_pixel_size"] = detector["y_pixel_size"] = PITCH
            for name in ("x_pixel_size", "y_pixel_size"):
                detector[name].attrs["units"] = "um"
            sample = entry.create_group("sample")
            sample.attrs["NX_class"] = "NXsample"
            radians = bool(rng.random() < 0.5)
            sample["rotation_angle"] = np.radians(scan.angles) if radians else scan.angles
            sample["rotation_angle"].attrs["units"] = "rad" if radians else "deg"
        return ["scan.nxs"]
    if layout == "exchange":
        with h5py.File(folder / "scan.h5", "w") as file:
            real = bool(rng.random() < 0.3)
            for name, data in (("data", view), ("data_white", flat), ("data_dark", dark)):
                file[f"exchange/{name}"] = data.astype(np.float32) if real else data
            file["exchange/theta"] = theta
        return ["scan.h5", "--pixel-size-um", str(PITCH)]
    np.savetxt(folder / "angles.txt", theta, fmt="%.6f")
    if layout == "tiffs":
        (folder / "scan").mkdir()
        for name, images in (("dark", dark), ("flat", flat), ("sample", view)):
            for i, image in enumerate(images):
                tifffile.imwrite(folder / "scan" / f"{name}_{i:04d}.tif", image)
        return ["scan", "--angles", "angles.txt", "--pixel-size-um", str(PITCH)]
    if layout == "stacks":
        for name, images in (("dark", dark), ("flat", flat), ("sample", view)):
            tifffile.imwrite(folder / f"{name}.tif", images, photometric="minisblack")
        references = ["--darks", "dark.tif", "--flats", "flat.tif"]
        return ["sample.tif", "--angles", "angles.txt", *references, "--pixel-size-um", str(PITCH)]
    light = np.maximum(flat.mean(axis=0) - dark.mean(axis=0), 1.0)
    through = np.maximum((view - dark.mean(axis=0)) / light, 1e-4).astype(np.float32)
    logarithm = bool(rng.random() < 0.5)
    with h5py.File(folder / "plain.h5", "w") as file:
        file["images"], file["omega"] = -np.log(through) if logarithm else through, theta
    quantity = "line-integrals" if logarithm else "transmission"
    paths = ["--data-path", "/images", "--angles-path", "/omega", "--angles-unit", "deg"]
    return ["plain.h5", *paths, "--quantity", quantity, "--pixel-size-um", str(PITCH)]


def tried(seed: int) -> dict[str, Any]:
    """One scan through `beamline recon -m fbp`: exit code, warnings, and the mass of the volume over the true one."""
    scan, rng = random_scan(seed), np.random.default_rng(seed + 10**6)
    layout = LAYOUTS[seed % len(LAYOUTS)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        arguments = written(scan, layout, folder, rng)
        paths = [str(folder / each) if (folder / each).exists() else each for each in arguments]
        out = ["-m", "fbp", "--no-report", "--json", "-o", str(folder / "volume.npy")]
        result = CliRunner().invoke(main, ["recon", *paths, *out])
        events = [json.loads(line) for line in result.stdout.splitlines() if line.startswith("{")]
        warned = [str(each.get("message")) for each in events if each.get("event") in ("Warned", "warned", "warning")]
        got = {"seed": seed, "layout": layout, "rc": result.exit_code, "warned": warned, **scan.about}
        if result.exit_code:
            return got | {"error": (result.stderr or repr(result.exception)).strip()[-600:]}
        volume = np.load(folder / "volume.npy")
    slices = volume.sum(axis=(1, 2), dtype=np.float64) * PITCH * 1e-3
    true = scan.lines[np.arange(len(scan.lines)) >= len(scan.lines) // 3].sum(axis=2).mean(axis=0)
    return got | {"mass": float(slices.sum() / true.sum()) if not scan.wide and len(slices) == len(true) else None}


def main_of(first: int, end: int) -> None:
    told: Counter[str] = Counter()
    for seed in range(first, end):
        try:
            got = tried(seed)
        except SceneError:
            continue  # no room for particles
        off = got.get("mass") is not None and not 0.85 < got["mass"] < 1.15
        if got["rc"] or got["warned"] or off:
            print(json.dumps(got, default=str), flush=True)
        told.update({re.sub(r"[-+]?\d[\d.e+-]*", "#", sentence)[:100] for sentence in got["warned"]})
        told.update(["refused"] if got["rc"] else [])
    print(f"{end - first} scans")
    for sentence, n in told.most_common():
        print(n, sentence)


if __name__ == "__main__":
    bounds = (sys.argv[1] if len(sys.argv) > 1 else "0:1000").split(":")
    main_of(int(bounds[0]), int(bounds[1]))
