"""Statistics of a raw scan are those of numpy over the same frames."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import ConfigError
from beamline.projections.scan_statistics import (
    PERCENT,
    DoseRequest,
    histograms,
    photon_dose_of,
    statistics_of,
    table,
)
from beamline.storage.readers.open import SourceOptions, open_scan
from recon.prep.matter import absorbed_dose
from tests.beamline.scans import TwoCylinders, frames_of, write_flagged

SCAN = TwoCylinders()


def test_counts_are_described_exactly_by_kind(tmp_path: Path) -> None:
    frames, said = frames_of(SCAN), []
    frames[6].counts[0, :3] = 65535
    with open_scan(write_flagged(tmp_path / "scan.h5", frames, {})) as source:
        found = statistics_of(source, lambda n, of: said.append((n, of)))
    assert [each.kind.name for each in found] == ["DARK", "FLAT", "PROJECTION"]
    for each in found:
        pixels = np.stack([frame.counts for frame in frames if frame.kind == each.kind]).astype(float)
        assert (each.frames, each.n_all) == (len(pixels), len(pixels))
        assert (each.minimum, each.maximum) == (pixels.min(), pixels.max())
        np.testing.assert_allclose((each.mean, each.deviation), (pixels.mean(), pixels.std()), rtol=1e-9)
        expected = np.percentile(pixels, PERCENT, method="inverted_cdf")
        np.testing.assert_array_equal(each.percentiles, expected)
        assert each.saturated == (pixels == 65535).mean()
        assert each.bin_counts.sum() == pixels.size
    assert said[-1] == (2 * len(frames), 2 * len(frames))
    assert histograms(found).startswith(b"\x89PNG")
    assert [row[0] for row in table(found)] == ["kind", "dark", "flat", "projection"]


def test_real_numbers_keep_their_range_and_those_that_are_none_are_counted(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    values = rng.normal(0.3, 1, (5, 20, 30)).astype(np.float32)
    values = values.astype(np.float64)
    values[0, 0, :6] = np.nan, np.inf, -np.inf, np.nan, 1e300, -1e17  # the last two are more than any detector counts
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file["data"] = values
    options = SourceOptions(tmp_path / "s.h5", data_path="data", angles=np.arange(5.0), quantity="line_integrals")
    with open_scan(options) as source:
        (views,) = statistics_of(source, lambda n, of: None)
    good = values[np.abs(values) < 1e10]
    np.testing.assert_allclose((views.mean, views.deviation), (good.mean(), good.std()), rtol=1e-5)
    expected = np.percentile(good, PERCENT, method="inverted_cdf")
    np.testing.assert_allclose(views.percentiles, expected, atol=float(np.ptp(good)) / 2**16)
    assert (views.not_finite, views.saturated) == (pytest.approx(6 / 3000), 0.0)
    assert views.absolute == pytest.approx(np.abs(good).sum() / 5, rel=1e-5)


def test_photons_and_dose_follow_from_the_flats(tmp_path: Path) -> None:
    path = write_flagged(tmp_path / "scan.h5", frames_of(SCAN), {}, pixel_size_mm=0.002, energy_kev=20.0)
    with open_scan(path) as source:
        found = statistics_of(source, lambda n, of: None)
        photons = (found[1].mean - found[0].mean) * 0.25
        light, dose = photon_dose_of(source, found, DoseRequest(0.25, "water")).in_words()
    views = SCAN.angles.size
    each = f"{photons:.4g} photons per pixel and projection in the open beam"
    assert light == f"{each}, {photons * views:.4g} in {views} projections"
    expected = absorbed_dose("water", 20.0, photons * views / 0.002**2)
    assert dose.startswith(f"{expected:.4g} Gy absorbed in water at 20 keV")


@pytest.mark.parametrize(
    ("energy_kev", "material", "kinds", "said"),
    [
        (None, "water", (0, 1, 2), "does not state the energy"),
        (20.0, "Xx", (0, 1, 2), "not a known material"),
        (20.0, None, (0,), "no darks and flats"),
    ],
)
def test_what_a_dose_lacks_is_said_before_any_frame_is_read(
    tmp_path: Path, energy_kev: float | None, material: str | None, kinds: tuple[int, ...], said: str
) -> None:
    frames = [replace(f, index=n) for n, f in enumerate(f for f in frames_of(SCAN) if f.kind in kinds)]
    path = write_flagged(tmp_path / "scan.h5", frames, {}, pixel_size_mm=0.002, energy_kev=energy_kev)
    asked = DoseRequest(0.25, material)
    with open_scan(path) as source, pytest.MonkeyPatch.context() as patch:
        patch.setattr(source, "read", lambda rows: pytest.fail(f"rows {rows} were read"))
        with pytest.raises(ConfigError, match=said):
            asked.refuse_impossible(source)
