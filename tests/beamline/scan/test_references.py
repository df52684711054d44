"""Bad darks and flats stop a scan before its first projection, with a reason, a safe instrument and a readable file."""

from pathlib import Path

import numpy as np
import pytest

from beamline.config.load import config_folder
from beamline.core.errors import ReferencesError
from beamline.core.events import Event
from beamline.features.files.validate import validate
from beamline.monitor.digest import digest
from beamline.monitor.references import ReferenceLimits
from beamline.scan.control import State
from beamline.scan.references import ReferenceLog
from beamline.scan.run import run_scan
from beamline.storage.readers.open import open_scan
from drivers.base.frame import Frame, FrameKind
from tests.beamline import fakes
from tests.beamline.ball_scan import shipped
from tests.beamline.fakes import FakeInstrument, Faults
from tests.beamline.ran import Ran


@pytest.mark.parametrize(
    ("light", "dark", "faults", "said"),
    [
        (210, 200, Faults(), "Flats in frames 3-4: these flats show no beam"),
        (20000, 15000, Faults(), "Darks in frames 0-2: these darks were exposed to the beam"),
        (20000, 200, Faults(lost={3, 4}), "The scan did not take the 2 flats that its plan has before the projections"),
    ],
)
def test_no_projection_is_taken_after_references_that_cannot_be_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, light: int, dark: int, faults: Faults, said: str
) -> None:
    monkeypatch.setitem(fakes.LEVEL, True, light)
    monkeypatch.setitem(fakes.LEVEL, False, dark)
    ran = Ran(tmp_path, FakeInstrument(faults))
    assert isinstance(ran.error, ReferencesError)
    assert said in str(ran.error) and "references.on_fault: log" in str(ran.error)
    assert [event.data["kind"] for event in ran.of("block_started")] == ["dark", "flat"]
    (done,), (failed,) = ran.of("scan_done"), ran.of("failed")
    assert (done.data["status"], failed.data["exit_code"]) == ("stopped", 6)
    assert ran.states == [State.PREPARING, State.DARKS, State.FLATS, State.FINISHING, State.STOPPED]
    assert any(event.data["message"].startswith(said) for event in ran.of("warning"))
    ran.assert_safe()
    assert ran.instrument.is_in
    with open_scan(done.data["path"]) as source:
        assert source.finished and len(list(source.frames())) == done.data["n_frames"]


@pytest.mark.parametrize(("wanted", "told"), [("references.on_fault=log", 1), ("references.light_in_darks=0.9", 0)])
def test_the_operator_may_want_the_scan_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wanted: str, told: int
) -> None:
    monkeypatch.setitem(fakes.LEVEL, False, 15000)
    ran = Ran(tmp_path, FakeInstrument(), wanted)
    assert ran.result.n_frames == 19
    assert ["these darks were exposed" in text for text in ran.warnings] == [True] * told


def test_bad_flats_at_the_end_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    last_view = 16  # after three darks and two flats
    ran = Ran(tmp_path, FakeInstrument(at={last_view: lambda: monkeypatch.setitem(fakes.LEVEL, True, 210)}))
    assert ran.result.reference_faults == tuple(ran.warnings)
    assert [text[:52] for text in ran.warnings] == ["Flats in frames 17-18: these flats show no beam. Was"]


def test_flats_without_the_light_of_the_views_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(fakes.LEVEL, True, 2000)
    instrument = FakeInstrument(at={5: lambda: monkeypatch.setitem(fakes.LEVEL, True, 20000)})  # the first view
    ran = Ran(tmp_path, instrument, "scan.flats.at=start")
    (fault,) = ran.result.reference_faults
    assert fault.startswith(
        "Flats in frames 3-4: these flats have only 9.09% of the intensity of the projections (limit 50%)"
    )
    assert [finding.severity for finding in validate(ran.result.path) if fault in finding.message] == ["error"]


def test_flats_without_beam_that_were_taken_again_are_no_fault() -> None:
    log, counts = ReferenceLog(), np.full((16, 16), 200, np.uint16)

    def add(row: int, kind: FrameKind, level: int, replaces: int = -1) -> None:
        pixels = counts + np.uint16(level)
        frame = Frame(pixels, kind, row, row, row, 0.0, float(row), 0.05, replaces)
        log.add(frame, digest(pixels))

    for row in range(3):
        add(row, FrameKind.DARK, 0)
    for row, level in ((3, 20000), (4, 50), (5, 20000)):
        add(row, FrameKind.FLAT, level)
    assert log.faults(ReferenceLimits()) != {}
    add(6, FrameKind.FLAT, 20000, replaces=4)
    assert log.faults(ReferenceLimits()) == {}


def _log(photons: float, exposure: float = 0.1, *, moving: float = 0.0, n_flats: int = 10) -> ReferenceLog:
    """Darks and flats with so many photons a pixel in the middle of a round beam, which moves from flat to flat."""
    rng, log, place = np.random.default_rng(5), ReferenceLog(), np.linspace(-1, 1, 128)
    for i in range(10 + n_flats):
        beam = np.exp(-0.5 * (place + moving * rng.normal()) ** 2) * np.ones((96, 1)) * (i >= 10)
        counts = 120 + 4.0 * rng.poisson(photons / np.median(np.exp(-0.5 * place**2)) * beam)
        image = (counts + rng.normal(0, 3, counts.shape)).round().astype(np.uint16)
        kind = FrameKind.FLAT if i >= 10 else FrameKind.DARK
        frame = Frame(image, kind, i, i, i, np.nan, float(i), exposure)
        log.add(frame, digest(image, 65535, 4))
    return log


@pytest.mark.parametrize(("photons", "moving"), [(5.0, 0.0), (14.5, 0.0), (60.0, 0.0), (60.0, 0.01)])
def test_too_little_light_is_told_with_its_photons(photons: float, moving: float) -> None:
    said = _log(photons, moving=moving).too_few_photons(ReferenceLimits(), 0.1)
    assert said is not None
    found = float(said.split("has ")[1].split(" photons")[0])
    assert found == pytest.approx(photons, rel=0.1)
    assert float(said.split("scan.exposure_s=")[1].split(",")[0]) == pytest.approx(0.1 * 100 / photons, rel=0.15)


@pytest.mark.parametrize(("photons", "moving"), [(150.0, 0.0), (5000.0, 0.0), (5000.0, 0.03)])
def test_enough_light_is_not_told_for_too_little(photons: float, moving: float) -> None:
    assert _log(photons, moving=moving).too_few_photons(ReferenceLimits(), 0.1) is None


def test_the_views_exposure_counts_and_one_flat_tells_nothing() -> None:
    assert _log(60.0, exposure=0.1).too_few_photons(ReferenceLimits(), 0.3) is None
    assert _log(200.0, exposure=0.1).too_few_photons(ReferenceLimits(), 0.025) is not None
    assert _log(14.5, n_flats=1).too_few_photons(ReferenceLimits(), 0.1) is None


def test_a_scan_with_too_little_light_says_so_before_its_first_view(tmp_path: Path) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text((config_folder() / "scenes" / "low_dose.yaml").read_text().replace("s: 300.0", "s: 290.0"))
    events: list[Event] = []
    config = shipped(
        "simulated", f"simulation.scene={scene}", "simulation.clock=virtual", "scan.angles.views=4", "scan.mode=step",
        "recon.live=false", "scan.exposure_s=0.05",
    )  # fmt: skip
    run_scan(config, tmp_path / "runs", [events.append])
    told = [i for i, event in enumerate(events) if "the beam is too weak" in str(event.data.get("message"))]
    views = [i for i, e in enumerate(events) if e.event == "block_started" and e.data["kind"] == "projection"]
    assert len(told) == 1 and told[0] < views[0]
    found = float(events[told[0]].data["message"].split("has ")[1].split(" photons")[0])
    assert found == pytest.approx(14.5, rel=0.1)
