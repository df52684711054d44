"""What is done about flagged views, measured: scans with floaters against the same scans without them.

Run with `pytest -m bench -s`. Samples and crumbs differ by seed. PSNR of OS-SIRT-TV within 0.4 mm of the axis.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import patch

import h5py
import numpy as np
import pytest
import yaml
from click.testing import CliRunner

import recon
from beamline.cli.main import main
from beamline.config.load import config_folder
from beamline.projections import usable_views as flags
from beamline.projections.corrections.preparation import Preparation
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.storage.readers.open import SourceOptions
from beamline.storage.rules import treatment
from recon.base.method import DataUse

pytestmark = [pytest.mark.bench, pytest.mark.timeout(0)]

SIDE, BIN = 256, 2
WAYS = {  # largest region in shares of a view, weight of rays in one, weight of a view with a warning of all of it
    "views": (0.0, 0.5, 0.5),
    "regions 0.5, views 0.5": (0.5, 0.5, 0.5),
    "regions 0.5, views 1": (0.5, 0.5, 1.0),
    "regions 0, views 1": (0.5, 1e-6, 1.0),
}


def scan(folder: Path, floaters: bool, seed: int) -> Path:
    settings = yaml.safe_load((config_folder() / "scenes" / "early_acquisition.yaml").read_text(encoding="utf-8"))
    settings["detector"] |= {"shape": [SIDE, SIDE], "pixel_size_um": 5.2}
    settings["axis_offset_px"] /= 2
    settings["phantom"]["seed"] = 20 + seed
    effects = list[Any]()
    for effect in settings["effects"]:
        kind = effect if isinstance(effect, str) else effect["kind"]
        if kind == "floaters" and floaters:
            effects.append(effect | {"seed": 30 + seed, "count": 3})
        elif kind not in ("floaters", "ghost", "jump", "lost_beam", "black_band", "narrow_field"):
            effects.append(effect)
    scene, path = folder / f"{floaters}{seed}.yaml", folder / f"{floaters}{seed}.h5"
    scene.write_text(yaml.safe_dump(settings | {"effects": effects}), encoding="utf-8")
    truth = ["--truth", str(folder / f"truth{seed}.h5"), "--truth-bin", str(BIN)] if not floaters else []
    done = CliRunner().invoke(main, ["simulate", str(scene), "--out", str(path), "--seed", str(seed), *truth])
    assert done.exit_code == 0, done.output
    return path


def psnr(path: Path, truth: np.ndarray, selection: Selection) -> float:
    with SourceOptions(path).open() as source:
        prepared = prepare_projections(source, selection, lambda _: None)
    use = DataUse(prepared.ray_weights())
    found = recon.reconstruct(prepared.projections.data, prepared.geometry, "os-sirt-tv", use=use).volume.data
    x = (np.arange(truth.shape[1]) - (truth.shape[1] - 1) / 2) * 5.2e-3 * BIN
    inside = np.hypot(*np.meshgrid(x, x)) < 0.4
    error = np.mean((found[:, inside] - truth[:, inside]) ** 2)
    return float(10 * np.log10(np.ptp(truth[:, inside]) ** 2 / error))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_regions_of_flags_are_worth(tmp_path: Path, seed: int) -> None:
    clean, path, rows = scan(tmp_path, False, seed), scan(tmp_path, True, seed), (90, 120)
    with h5py.File(tmp_path / f"truth{seed}.h5") as file:
        truth = file["entry/data/data"][rows[0] // BIN : rows[1] // BIN]
    axis = (SIDE - 1) / 2 - 2.6
    every = Selection(rows=rows, binning=BIN, axis_col=axis, steps=(Preparation("ignore"),))
    judged = Selection(rows=rows, binning=BIN, axis_col=axis, steps=(Preparation("judge"),))
    found = {"clean": psnr(clean, truth, every), "ignore": psnr(path, truth, every)}
    for name, (largest, share, weight) in WAYS.items():
        of_regions = patch.object(treatment, "LARGEST", largest), patch.object(flags, "WARNED_SHARE", share)
        with of_regions[0], of_regions[1], patch.object(flags, "WARNED_WEIGHT", weight):
            found[name] = psnr(path, truth, judged)
    print(f"\nseed {seed}: " + ", ".join(f"{name} {value:.2f} dB" for name, value in found.items()), flush=True)
