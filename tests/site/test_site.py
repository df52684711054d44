"""A site's own package: one of each kind by entry points alone, and each passes the suite that is shipped for it."""

from __future__ import annotations

import itertools
import math
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.storage.readers import formats as readers
from beamline.testing import ReaderConformance
from drivers.base.protocols import CameraSettings, TriggerSource
from drivers.testing.camera import CameraBench, CameraConformance
from drivers.testing.stages import Build, StageBench, StageConformance, StageKind
from recon.testing import MethodConformance
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.wire import register
from tests.site.site_of_an_instrument.cameras import SiteCamera, SiteCameraSettings
from tests.site.site_of_an_instrument.methods import Mean
from tests.site.site_of_an_instrument.readers import FORMAT
from tests.site.site_of_an_instrument.stages import SiteStage, SiteStageSettings
from tests.site.site_of_an_instrument.wires import SiteBuild

HERE = Path(__file__).parent
GROUPS = [
    f"splatline.{kind}"
    for kind in ("method", "correction", "reader", "volume_format", "stage", "wire", "camera", "check", "effect")
]
NAMES = (f"site-{number}" for number in itertools.count())
FIGURES = {
    "counts_per_turn": 360_000, "max_speed": math.radians(30), "acceleration": math.radians(60),
    "low": math.radians(-5), "high": math.radians(100),
}  # fmt: skip


class TestMean(MethodConformance):
    @pytest.fixture
    def method(self) -> Mean:
        return Mean()


class TestNpyStack(ReaderConformance):
    @pytest.fixture
    def path(self, tmp_path: Path, frames: NDArray[Any], monkeypatch: pytest.MonkeyPatch) -> Path:
        monkeypatch.setattr(readers, "FORMATS", (*readers.FORMATS, FORMAT))
        np.save(tmp_path / "scan.npy", frames)
        return tmp_path / "scan.npy"

    @pytest.fixture
    def frames(self) -> NDArray[Any]:
        return np.arange(60, dtype=np.uint16).reshape(5, 3, 4)


class TestSiteCamera(CameraConformance):
    @pytest.fixture
    def bench(self) -> CameraBench:
        clock = VirtualClock()
        camera = SiteCamera(SiteCameraSettings(), clock)
        settings = CameraSettings(0.01, TriggerSource.EXTERNAL, (0, 0, 30, 20))
        refused = (({"exposure": 1e-9}, "expected 1e-5"), ({"binning": 2}, "does not bin"))
        return CameraBench(camera, clock, camera.pulses.extend, settings, refused)


class TestSiteStage(StageConformance):
    @pytest.fixture
    def kind(self) -> StageKind:
        return StageKind(width=None, inverts=True)

    @pytest.fixture
    def build(self, kind: StageKind) -> Iterator[Build]:
        def build(**changes: Any) -> StageBench:
            clock = VirtualClock()
            line, settings = TriggerLine(clock), SiteStageSettings(**FIGURES | changes)
            url = register(next(NAMES), SiteBuild.matching(settings).controller(clock, line))
            return StageBench(SiteStage(url, settings, clock), clock, line)

        yield build


PROOF = """
import math, sys, warnings
from pathlib import Path
import numpy as np
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    import recon
    from beamline.config.load import config_folder, load
    from beamline.instrument.connect import connect, describe
    from beamline.monitor.checks import CHECKS
    from beamline.storage.readers.open import SourceOptions, open_scan
    from beamline.storage.volumes.files import opened_volume, write_volume
    from beamline.storage.volumes import suffixes_text
    from recon import methods
    from simulators.effects.catalogue import CATALOGUE
    from simulators.scenes.scene import load_scene
    names = methods.names()
    text = suffixes_text()
    from beamline.projections.registry import all_steps
    steps = [step.name for step in all_steps()]
    from beamline.instrument.simulated import WIRES
    wires = list(WIRES)  # plug-ins are looked up when a registry is first asked

left_out = {str(one.message).split(" was left out")[0] for one in told if "left out" in str(one.message)}
package = "of the package site-of-an-instrument"
kinds = ("method", "correction", "reader", "volume format", "stage", "wire", "camera", "check", "effect")
assert left_out == {f"The {kind} 'wrong' {package} (math:pi)" for kind in kinds} | {
    f"The correction 'air' {package} (site_of_an_instrument.corrections:Lift)",
    f"The effect 'gone' {package} (no_such_module:Gone)",
    f"The method 'fbp' {package} (site_of_an_instrument.methods:Mean)",
    f"The volume format 'taken' {package} (beamline.storage.volumes.files:Npy)",
}, left_out

grid = recon.Grid((2, 8, 8), 1.0)
volume = recon.Volume(np.arange(128, dtype=np.float32).reshape(grid.shape), grid)
assert names[-1] == "mean" and "fbp" in names
assert methods.by_name("mean").label == "Mean of two" and not methods.streams("mean")

assert steps.index("lift") > steps.index("hardening")
from click.testing import CliRunner
from beamline.cli.main import main
assert "--lift BY" in CliRunner().invoke(main, ["recon", "--help-all"]).output

np.save("scan.npy", np.arange(24, dtype=np.uint16).reshape(2, 3, 4))
with open_scan(SourceOptions("scan.npy", angles=[0.0, 1.0])) as source:
    assert source.format == "npy_stack"

from beamline.storage.recon_record import ReconRecord
record = ReconRecord(
    volume=volume, length_unit="mm", raw_file="a", title="a", sample="a", time=0.0, parameters={}, metrics={}
)
write_volume(Path("v.raw"), record)
with opened_volume(Path("v.raw")) as read:
    np.testing.assert_array_equal(read.volume.data, volume.data)
assert ".raw" in text

figures = "counts_per_turn: 360000, max_speed_deg_s: 30, acceleration_deg_s2: 60, trigger_line: 1, brake_s: 0.2"
config = load(config_folder() / "simulated.yaml", [
    "devices.stage={kind: site_stage, port: 'sim://site_stage', %s}" % figures, "monitor.half.share=0.25",
    "simulation.clock=virtual",
], {})
assert config.devices.stage.settings.brake == 0.2
with connect(config) as instrument:
    stage = instrument.devices.stage
    assert type(stage).__name__ == "SiteStage" and stage.position() == 0
assert CHECKS[-1].name == "half"

config = load(config_folder() / "instrument.yaml", [
    "devices.camera={kind: site_camera, roi: [0, 0, 40, 60], readout_s: 0.5}", "scan.mode=step",
    "scan.period_s=10", "recon.axis=auto",
], {})
limits, timing, to_counts = describe(config)
assert timing.shape == (40, 60) and timing.readout == 0.5
assert config.devices.camera.connect(None).describe()["model"] == "site camera"

scene = load_scene({"phantom": {"kind": "solids", "solids": [
    {"kind": "ellipsoid", "semi_axes": [0.1, 0.1, 0.1], "attenuation": 1.0}]},
    "beam": {"photons_per_s": 1e5}, "effects": ["dimmed"]})
assert [effect.name for effect in scene.chain.effects] == ["dimmed"]
assert CATALOGUE["dimmed"].summary == "a share of the light is lost"
print("all there")
"""


def _installed(folder: Path, others: Sequence[tuple[str, str]]) -> None:
    """What pip makes of the package, and entry points that cannot be taken."""
    told = tomllib.loads((HERE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    facts = folder / "site_of_an_instrument-1.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {told['name']}\nVersion: 1\n", encoding="utf-8")
    groups: dict[str, dict[str, str]] = told["entry-points"]
    for group, line in others:
        groups[group] = groups.get(group, {}) | dict([line.split(" = ")])
    lines = [
        f"[{group}]\n" + "".join(f"{name} = {at}\n" for name, at in found.items()) for group, found in groups.items()
    ]
    (facts / "entry_points.txt").write_text("\n".join(lines), encoding="utf-8")
    shutil.copytree(HERE / "site_of_an_instrument", folder / "site_of_an_instrument")


@pytest.mark.slow  # the imports of a process without compilation
def test_one_of_each_kind_is_found_by_its_entry_point_and_what_does_not_fit_is_named(tmp_path: Path) -> None:
    _installed(
        tmp_path,
        [
            *((group, "wrong = math:pi") for group in GROUPS),
            ("splatline.method", "fbp = site_of_an_instrument.methods:Mean"),
            ("splatline.correction", "air = site_of_an_instrument.corrections:Lift"),
            ("splatline.effect", "gone = no_such_module:Gone"),
            ("splatline.volume_format", "taken = beamline.storage.volumes.files:Npy"),
        ],
    )
    path = os.pathsep.join([str(tmp_path), str(HERE.parents[1])])
    environment = os.environ | {"PYTHONPATH": path, "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-c", PROOF]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=200, check=False
    )
    assert done.stdout.strip() == "all there", done.stderr[-3000:]
