"""A series of energies: one scan for each in one folder, which can continue after a stop."""

import hashlib
import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner, Result

from beamline.cli.main import main
from beamline.config.load import config_folder, load
from beamline.scan.dry_run import dry_run
from beamline.storage.readers.open import open_scan
from drivers.base.frame import FrameKind
from simulators.devices.camera import SimulatedOrcaQuest

pytest.importorskip("xraylib")
ENERGIES = (8.32, 8.345, 8.3485, 8.352)
VIEWS = 16
PITCH = 2.2e-3  # mm
GRAINS = {"charged": (-0.03, 0.0), "fresh": (0.025, 0.01)}
SCENE = {
    "phantom": {
        "kind": "solids",
        "materials": {
            name: {"formula": "LiNi0.8Mn0.1Co0.1O2", "density": 4.784, "state_of_charge": charge}
            for name, charge in (("charged", 1.0), ("fresh", 0.0))
        },
        "solids": [
            {"kind": "ellipsoid", "semi_axes": [0.012, 0.012, 0.03], "material": name, "centre": [*place, 0.0]}
            for name, place in GRAINS.items()
        ],
    },
    "beam": {"photons_per_s": 1.0e5, "energy_kev": 8.3485},
    "effects": ["photon_noise"],
}


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration of four energies."""
    tree = yaml.safe_load((config_folder() / "simulated.yaml").read_text("utf-8"))
    tree["sample"]["name"] = "grains"
    tree["scan"] |= {
        "mode": "step",
        "angles": {"scheme": "fixed", "views": VIEWS, "start_deg": 0, "span_deg": 180},
        "energies": list(ENERGIES),
        "darks": {"count": 2},
        "flats": {"count": 4},
    }
    tree["devices"]["camera"]["roi"] = [1148, 2016, 4, 64]
    tree["devices"]["monochromator"] = {"kind": "simulated"}
    tree["optics"]["pixel_size_um"] = PITCH * 1e3
    tree["recon"]["live"] = False
    tree["monitor"]["bands"]["alarm"] = 0.99  # two grains that pass one another, in steps of 11 degrees
    tree["simulation"] |= {"scene": SCENE, "clock": "virtual"}
    path = tmp_path_factory.mktemp("config") / "series.yaml"
    path.write_text(yaml.safe_dump(tree), "utf-8")
    return path


def beamline(*words: Any) -> Result:
    return CliRunner().invoke(main, [str(word) for word in words])


def digests(folder: Path) -> dict[str, str]:
    return {path.parent.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.glob("*/scan.h5")}


@pytest.mark.slow
def test_each_energy_has_a_scan(config: Path, tmp_path: Path) -> None:
    done = beamline("scan", config, "-o", tmp_path / "runs")
    assert done.exit_code == 0, done.output
    assert f"Energy 4 of 4: {ENERGIES[3]} keV" in done.stderr and f"{ENERGIES[0]} keV" in done.stdout
    (series,) = (tmp_path / "runs").iterdir()
    scans = sorted(series.glob("*/scan.h5"), key=lambda path: path.stat().st_mtime)
    assert [path.parent.name.split("_")[-1] for path in scans] == [f"{energy}keV" for energy in ENERGIES]
    angles, noise = list[float](), list[np.ndarray]()
    for path, energy in zip(scans, ENERGIES, strict=True):
        with open_scan(path) as source:
            assert source.energy_kev == energy
            views = [frame for frame in source.frames() if frame.kind is FrameKind.PROJECTION]
            angles += [frame.angle for frame in views]
            noise.append(views[0].counts[0, :8].astype(float))
    step = np.pi / VIEWS / len(ENERGIES)
    assert np.diff(np.sort(angles)) == pytest.approx(np.full(VIEWS * len(ENERGIES) - 1, step), abs=2e-5)
    assert not any((noise[0] == other).all() for other in noise[1:])  # each energy has noise of its own
    listed = beamline("runs", tmp_path / "runs").stdout
    assert all(f"{series.name}/{path.parent.name}" in listed for path in scans), listed


@pytest.mark.slow
@pytest.mark.parametrize("at", [22 + 2, pytest.param(22 + 14, marks=pytest.mark.long)])
def test_a_series_that_was_stopped_goes_on(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: int
) -> None:
    """Stopped in the second energy: before its first view, or among its views."""
    taken, take = [0], SimulatedOrcaQuest.next_frame

    def stopping(self: SimulatedOrcaQuest, timeout: float) -> Any:
        taken[0] += 1
        if taken[0] == at:
            signal.raise_signal(signal.SIGINT)
        return take(self, timeout)

    monkeypatch.setattr(SimulatedOrcaQuest, "next_frame", stopping)
    ended = beamline("scan", config, "-o", tmp_path)
    assert ended.exit_code in (4, 5), ended.output
    (series,) = tmp_path.iterdir()
    assert f"beamline scan --resume {series}" in ended.stderr.replace("\n", " ")
    before = digests(series)
    whole = [name for name in before if f"{ENERGIES[0]}keV" in name]
    done = beamline("scan", "--resume", series, "--json")
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout.splitlines()[-1])
    assert [scan["energy_kev"] for scan in said["scans"]] == list(ENERGIES)
    for scan in said["scans"]:
        with open_scan(Path(scan["path"])) as source:
            kinds = source.table.kinds
            assert (kinds == FrameKind.PROJECTION).sum() == VIEWS
    assert all(digests(series)[name] == before[name] for name in whole)
    with monkeypatch.context() as without:
        without.setattr("beamline.scan.series.connect", None)  # nothing is missing: no device is connected
        assert beamline("scan", "--resume", series, "--json").exit_code == 0
    other = beamline("scan", config, "--set", "scan.energies=[8.3, 8.4]", "--resume", series)
    assert other.exit_code == 2 and "`- 8.32` instead of `- 8.3`" in other.stderr.replace("\n", " ")


@pytest.mark.slow
def test_a_scan_that_cannot_be_read_is_moved_away_and_taken_anew(config: Path, tmp_path: Path) -> None:
    """A writer that dies before its first frame leaves a file that nothing recovers."""
    words = ("--set", "scan.energies=[8.32, 8.345]")
    assert beamline("scan", config, "-o", tmp_path, *words).exit_code == 0
    (series,) = tmp_path.iterdir()
    broken = sorted(series.glob("*/scan.h5"))[1]
    broken.write_bytes(broken.read_bytes()[:4000])
    ended = beamline("scan", "--resume", series)
    said = " ".join(ended.stderr.split())
    assert ended.exit_code == 5 and f"{broken.parent} cannot be recovered, move it to another place" in said, said
    broken.parent.rename(tmp_path / "away")
    done = beamline("scan", "--resume", series, "--json")
    assert done.exit_code == 0 and len(json.loads(done.stdout.splitlines()[-1])["scans"]) == 2, done.output


def test_a_dry_run_counts_all_energies(config: Path, tmp_path: Path) -> None:
    one = json.loads(beamline("check", config, "--json", "--set", "scan.energies=null").stdout)
    all_ = json.loads(beamline("check", config, "--json").stdout)
    assert [each["kev"] for each in all_["energies"]] == list(ENERGIES) and one["energies"] == []
    assert sum(each["total_bytes"] for each in all_["energies"]) == 4 * one["total_bytes"]
    assert sum(each["duration"] for each in all_["energies"]) == pytest.approx(
        4 * one["duration"], rel=0.03
    )  # each begins later in angle
    rest = dry_run(load(config), complete=ENERGIES[:3])
    assert [need.kev for need in rest.energies] == [ENERGIES[3]]
    assert rest.needs.total_bytes == one["total_bytes"]  # the disk needs no room for those that were taken
    told = beamline("scan", config, "--dry-run", "-o", tmp_path / "none")
    assert "energies  4, 8.32 to 8.352 keV, one scan like this at each energy" in told.stdout
    assert told.exit_code == 0 and not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("scan.energies=[8.3, 8.3]",), "lists 8.3 keV twice"),
        (("scan.energies=[8.3, 8.30000000001]",), "keV twice (rounded to seven digits)"),
        (("scan.energy=8.3",), "exclude each other"),
        (("devices.monochromator={kind: none}",), "scan.energies sets an energy, but no monochromator is configured"),
        (("devices.monochromator={kind: simulated, range_kev: [8, 8.35]}",), "8.352 keV is not within"),
        (("recon.live=true", "scan.decide=do"), "set scan.energies to null"),
        (("simulation.scene.beam.energy_kev=null", "simulation.scene.beam.tube={kv: 60}"), "gives a single energy"),
        (("simulation.scene.phantom.materials.fresh.formula=Xx",), "Xx"),
        (("scan.energies=[8.3, 9000]",), "9000"),
        (("scan.energies=[.nan]",), "scan.energies.0 is .nan"),
        (("devices.monochromator={kind: simulated, range_kev: [25, 4]}",), "expected the lower energy first"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(config: Path, tmp_path: Path, words: tuple[str, ...], said: str) -> None:
    ended = beamline("scan", config, "-o", tmp_path / "runs", *(part for word in words for part in ("--set", word)))
    assert ended.exit_code == 2, ended.output
    (line,) = ended.stderr.strip().splitlines()
    assert said in line
    assert not (tmp_path / "runs").exists()
