"""From the folder of a series of scans come the volumes of materials, and the edge of the grains."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beamline.storage.volumes.files import opened_volume
from recon.features.joint import spectral
from simulators.samples.materials.materials import known
from tests.beamline.cli.small_scan import beamline
from tests.beamline.scan.test_energies import ENERGIES, GRAINS, PITCH, config

__all__ = ["config"]


def spectra(folder: Path) -> Path:
    columns = [
        replace(known("NMC811"), state_of_charge=charge).attenuation(np.array(ENERGIES)) for charge in (1.0, 0.0)
    ]
    rows = [f"{energy},{a},{b}" for energy, a, b in zip(ENERGIES, *columns, strict=True)]
    path = folder / "spectra.csv"
    path.write_text("\n".join(["energy_kev,charged,fresh", *rows]))
    return path


def test_a_series_gives_the_materials(config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spectral, "weights_by_views", lambda views, *_: np.full(views.cross_sections.shape[1], 7e-4))
    done = beamline("scan", config, "-o", tmp_path / "runs")
    assert done.exit_code == 0, done.output
    (series,) = (tmp_path / "runs").iterdir()
    words = ("--spectra", spectra(tmp_path), "-o", tmp_path / "out.h5", "--axis", "31.5")
    made = beamline("materials", series, *words)
    assert made.exit_code == 0 and "energies have a complete scan" not in made.stderr, made.output
    y, x = (np.mgrid[:64, :64] - 31.5) * PITCH
    for name in GRAINS:
        with opened_volume(tmp_path / f"out_{name}.h5") as record:
            middle = np.asarray(record.volume.data)[1]
        for grain, at in GRAINS.items():
            inside = float(np.median(middle[np.hypot(x - at[0], y - at[1]) < 0.006]))
            assert inside == pytest.approx(float(grain == name), abs=0.15)


@pytest.mark.parametrize("words", [("xafs",), ("materials", "-o", "out.h5", "--spectra", "spectra.csv")])
def test_a_series_without_scans_is_refused(
    config: Path, tmp_path: Path, words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    spectra(tmp_path)
    (tmp_path / "series").mkdir()
    (tmp_path / "series" / "config.resolved.yaml").write_bytes(config.read_bytes())
    ended = beamline(*words, "series")
    assert ended.exit_code == 5 and "series has no scan yet: `beamline scan --resume series`" in ended.stderr


@pytest.mark.slow
def test_a_series_is_a_spectrum(config: Path, tmp_path: Path) -> None:
    """The mean of a region over the views of each energy has the edge of the grains."""
    energies = [round(8.33 + 0.002 * n, 4) for n in range(13)]
    words = ("scan.angles.views=4", f"scan.energies={energies}", "scan.flats.count=2")
    done = beamline("scan", config, "-o", tmp_path, *(part for word in words for part in ("--set", word)))
    assert done.exit_code in (0, 7), done.output
    (series,) = tmp_path.iterdir()
    found = beamline("xafs", series, "--region", "0:4,8:56", "--json", "-o", tmp_path / "edge.png")
    assert found.exit_code == 0, found.output
    (said,) = json.loads(found.stdout.splitlines()[-1])["states"]
    assert said["n_energies"] == 13 and said["edge_kev"] == pytest.approx(8.344, abs=0.002)
