"""Dummies of each kind of extension: files, lines of registries, and a program that proves that it works."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Extension:
    """A dummy.

    Attributes:
        files: its own, by path.
        lines: the registries: path, the line above, and the line that is added.
        proof: a program that ends without an error only where the dummy works.
    """

    files: Mapping[str, str]
    lines: tuple[tuple[str, str, str], ...]
    proof: str


METHOD = Extension(
    {
        "recon/voxels/grey.py": """
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from recon.base.method import Reconstruction
from recon.base.method_kinds import Direct
from recon.base.volume import Volume


@dataclass(frozen=True)
class Grey(Direct):
    name: ClassVar[str] = "grey"
    label: ClassVar[str] = "Grey"
    iterations: int = 1
    shade: float = 0.5

    def run(self, problem, control):
        return Reconstruction(Volume(np.full(problem.grid.shape, self.shade, np.float32), problem.grid), {})

    def toy(self):
        return self

    def memory(self, geometry, grid, weighted):
        return 4 * grid.shape[0] * grid.shape[1] * grid.shape[2]
"""
    },
    (
        (
            "recon/methods.py",
            '    "fbp": MethodEntry("recon.voxels.direct", "Fbp"),',
            '    "grey": MethodEntry("recon.voxels.grey", "Grey"),',
        ),
    ),
    """
import numpy as np
import recon
from click.testing import CliRunner
from beamline.cli.recon import recon as command
from beamline.features.trials.command import tradeoff
from recon.methods import taking
from beamline.reconstruct.scan_facts import label_of
from beamline.features.trials.tradeoff import plan
from recon import methods

views, data = recon.Geometry.parallel([0.0, 1.0], (2, 3)), np.ones((2, 2, 3))
for method in ("grey", recon.Grey()):
    assert (recon.reconstruct(data, views, method).volume.data == 0.5).all()
white = methods.build(methods.by_name("grey"), {"shade": 1.0})
assert (recon.reconstruct(data, views, white).volume.data == 1).all()
trials = plan(("grey", "fbp"), 60, "quick")
labels = {t.label for t in trials if t.method == "grey"}
assert labels == {"grey, 60 views", "grey, 30 views"}, labels
for offered in (command, tradeoff):
    assert "grey" in CliRunner().invoke(offered, ["--help"]).output
assert "grey" in taking("iterations") and "grey" not in taking("tv_weight")
assert label_of("grey") == "Grey"
""",
)

CHECK = Extension(
    {
        "beamline/monitor/dummy.py": '''
"""A check that flags every second frame."""

from dataclasses import dataclass
from typing import ClassVar

from beamline.monitor.check import Flag, Level, CheckResult, Policy
from recon.base.setting import setting


@dataclass(frozen=True)
class Dummy:
    name: ClassVar[str] = "dummy"
    bit: ClassVar[int] = 47
    unit: ClassVar[str] = "frames"
    meaning: ClassVar[str] = "the frame is one of a pair"
    policy: ClassVar[Policy] = Policy.LOG
    every: int = setting(3, "frames between two flags", ge=2)

    def start(self):
        return 0

    def look(self, state, frame, digest, context):
        if (state + 1) % self.every:
            return CheckResult(state + 1)
        return CheckResult(state + 1, Flag(self.name, Level.ALARM, frame.index, state + 1, self.every, "Do nothing."))
'''
    },
    (("beamline/monitor/checks.py", '    "DarkCheck": "frames",', '    "Dummy": "dummy",'),),
    """
from beamline.config.load import config_folder, load
from beamline.core.errors import ConfigError
from beamline.scan.run import run_scan
from beamline.features.files.validate import describe
import h5py
from pathlib import Path

words = ["simulation.clock=virtual", "scan.angles.views=6", "devices.camera.roi=[1140, 2008, 24, 80]"]
words += ["scan.darks.count=2", "scan.flats.count=2", "scan.flats.at=start", "scan.period_s=2", "scan.mode=step"]
path = config_folder() / "demo.yaml"
try:
    load(path, ["monitor.dummy.every=1"], {})
except ConfigError as error:
    refused = str(error)
config, flags = load(path, [*words, "monitor.dummy.every=2"], {}), []
sinks = [lambda event: flags.append(event.data.get("check"))]
result = run_scan(config, Path("runs"), sinks)
with h5py.File(result.path) as file:
    legend = file["entry/frame_log/flag_legend"]
    row = list(legend["name"].asstr()[()]).index("dummy")
    said = [int(legend[name][row]) for name in ("bit", "alarm_bit")]
    said += [legend[name].asstr()[row] for name in ("unit", "meaning")]
    bits = [int(b) & (1 << 47 | 1 << 63) for b in file["entry/frame_log/flags"][()]]
info = describe(result.path)["flags"]
assert "monitor.dummy.every is 1; expected a whole number >= 2" in refused
assert result.flags["dummy"] == {"alarm": 5} and "dummy" in flags
assert said == [47, 63, "frames", "the frame is one of a pair"]
assert bits == [0, 1 << 47 | 1 << 63] * 5
assert info["dummy"] == {"alarm": 5}
""",
)

EFFECT = Extension(
    {
        "simulators/effects/half.py": """
from dataclasses import dataclass
from typing import ClassVar

from simulators.effects.catalogue import Domain


@dataclass(frozen=True)
class Half:
    factor: float = 0.5
    name: ClassVar[str] = "half"
    domain: ClassVar[Domain] = Domain.PHOTONS
    final: ClassVar[bool] = False

    def apply(self, image, shot):
        image *= self.factor
        return image
"""
    },
    (
        (
            "simulators/effects/catalogue.py",
            '        "photon_noise": _sensor(Domain.PHOTONS, "photons arrive at random"),',
            '        "half": EffectRow(Domain.PHOTONS, "half of the light", module="simulators.effects.half"),',
        ),
    ),
    """
import numpy as np
from tests.simulators import shots
from tests.simulators.effects.on_demand import shot
from simulators.scenes.expose import expose

whole, half = (expose(shots.scene(*effects, flux=4000.0), shot(1)) for effects in ((), ({"kind": "half"},)))
assert whole.mean() > 100
np.testing.assert_allclose(half, whole / 2, atol=1)
""",
)

READER = Extension(
    {
        "beamline/storage/readers/npy_stack.py": """
import numpy as np

from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.base import WHOLE, ScanFormat, ScanSource, frame_indices
from drivers.base.frame import FrameKind


class NpyStack(ScanSource):
    format = "npy_stack"

    def __init__(self, path):
        self.path, self._data = path, np.load(path, allow_pickle=False)
        n, *shape = self._data.shape
        self.shape, self.dtype, self.facts = tuple(shape), self._data.dtype, {}
        self.table = FrameTable.of(np.full(n, FrameKind.PROJECTION))

    def read(self, frames, rows=WHOLE):
        return self._data[frame_indices(frames, len(self._data)), rows]

    def close(self):
        pass


FORMAT = ScanFormat("an .npy stack", lambda path, opening: path.suffix == ".npy", lambda path, opening: NpyStack(path))
"""
    },
    (
        (
            "beamline/storage/readers/open.py",
            '    "dxchange",',
            '    "npy_stack",',
        ),
    ),
    """
import numpy as np
from beamline.features.files.validate import describe
from beamline.storage.readers.open import SourceOptions, open_scan

data = np.arange(24, dtype=np.uint16).reshape(2, 3, 4)
np.save("scan.npy", data)
with open_scan(SourceOptions("scan.npy", angles=[0.0, 1.0])) as source:
    np.testing.assert_array_equal(source.read([1], slice(1, 3)), data[1:, 1:3])
    assert [frame.angle for frame in source.frames()] == [0, 1] and source.refresh() == 2
assert describe("scan.npy")["format"] == "npy_stack"
""",
)

STAGE = Extension(
    {
        "drivers/stages/turn/__init__.py": '"""A dummy stage."""\n\nDRIVERS = {"turn": "TurnStage"}\n',
        "drivers/stages/turn/stage.py": '''
from dataclasses import dataclass
from typing import ClassVar

import serial

from drivers.stages.settings import StageFigures, Wiring
from recon.base.setting import setting


@dataclass(frozen=True, kw_only=True)
class TurnSettings(Wiring, StageFigures):
    """A dummy."""

    pulse_output: ClassVar[None] = None
    gear: int = setting(2, "Counts a step.", ge=1)

    def limits(self):
        return self.limits_with(self.acceleration, 0.0)


class TurnStage:
    name, Settings = "stage", TurnSettings

    def __init__(self, url, settings, clock):
        self.limits, self._line = settings.limits(), serial.serial_for_url(url, timeout=settings.timeout)
        self._gear = settings.gear

    def position(self):
        self._line.write(b"?")
        return int(self._line.read(4)) / self._gear

    def close(self):
        self._line.close()
''',
        "simulators/wires/turn/__init__.py": '"""The dummy controller."""\n\nCONTROLLERS = {"turn": "TurnBuild"}\n',
        "simulators/wires/turn/wire.py": """
from dataclasses import dataclass


class TurnController:
    def __init__(self, clock, counts):
        self.clock, self._counts, self._reply = clock, counts, b""

    def receive(self, data):
        self._reply += b"%04d" % self._counts * len(data)

    def transmit(self):
        reply, self._reply = self._reply, b""
        return reply

    def output_is_high(self, number):
        return False


@dataclass(frozen=True)
class TurnBuild:
    counts: int = 12

    @classmethod
    def matching(cls, settings):
        return cls(counts=6 * settings.gear)

    def controller(self, clock, line):
        return TurnController(clock, self.counts)
""",
    },
    (),
    """
import math
from beamline.config.load import config_folder, load
from beamline.core.errors import ConfigError
from beamline.instrument.connect import connect
from beamline.scan.preflight import dry_run
from drivers.base.clock import SystemClock
from beamline.instrument.simulated import WIRES

turn = "kind: turn, port: 'sim://turn', counts_per_turn: 3600, max_speed_deg_s: 90, acceleration_deg_s2: 180"
path = config_folder() / "simulated.yaml"
config = load(path, ["devices.stage={%s, gear: 3}" % turn], {})
assert dry_run(config).lines()
with connect(config) as instrument:
    stage = instrument.devices.stage
    assert stage.position() == 6 and math.isclose(stage.limits.max_speed, math.pi / 2)
try:
    load(path, ["devices.stage={%s, gear: 0}" % turn], {})
except ConfigError as error:
    assert "devices.stage" in str(error) and "gear" in str(error), error
else:
    raise AssertionError("a gear of 0 was taken")
wire = WIRES["turn"](7).controller(SystemClock(), None)
wire.receive(b"?")
assert wire.transmit() == b"0007"
""",
)

STEP = Extension(
    {
        "beamline/projections/corrections/lift.py": """
from dataclasses import dataclass
from typing import ClassVar

from beamline.projections.step import StepDone, StepMemory, option


@dataclass(frozen=True)
class Lift:
    name: ClassVar[str] = "lift"
    follows: ClassVar[tuple[str, ...]] = ("hardening",)
    by: float = option("--lift", "0", "Add this to all line integrals.", parse=float, metavar="BY")

    def __post_init__(self):
        if self.by < 0:
            raise ValueError("--lift: nothing is taken off.")

    @property
    def needs_finished(self):
        return "--lift is for a finished scan." if self.by else ""

    def memory(self, part):
        return StepMemory(alone=10**9 if self.by else 0)

    def apply(self, views, angles, progress):
        views.projections.data[...] += self.by
        return StepDone(f"Lifted by {self.by:g}." if self.by else "")
"""
    },
    (("beamline/projections/registry.py", '    "Width": "width",', '    "Lift": "lift",'),),
    """
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from beamline.cli.main import main
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.projections.corrections.air import Air
from beamline.projections.corrections.lift import Lift
from beamline.projections.registry import in_order, recorded
from beamline.storage.readers.open import SourceOptions, open_scan
from tests.beamline.scans import TwoCylinders, write_exchange

path = write_exchange(Path("lift.h5"), TwoCylinders(shape=(2, 40)))
with open_scan(SourceOptions(path)) as source:
    chosen = [Selection(axis_col=20.7, steps=(Air("none"), *steps)) for steps in ((), (Lift(0.5),))]
    plain, lifted = (prepare_projections(source, each, print) for each in chosen)
np.testing.assert_allclose(lifted.projections.data, plain.projections.data + 0.5, atol=1e-6)
assert lifted.done["lift"].sentence == "Lifted by 0.5."
found = recorded(in_order(chosen[1]), lifted.done)
assert (found["lift"], found["lift_said"]) == (0.5, "Lifted by 0.5.")

def run(*options):
    done = CliRunner().invoke(main, ["recon", "lift.h5", "-m", "r2", "--axis", "20.7", *options])
    return done.exit_code, done.output

assert "lift: 0.5" in run("--lift", "0.5", "--write-config", "-")[1]
Path("recipe.yaml").write_text("method: r2\\nlift: 0.7\\n")
assert "lift: 0.7" in run("--config", "recipe.yaml", "--write-config", "-")[1]
code, said = run("--lift", "1", "--follow")
assert code == 2 and "--lift is for a finished scan" in said
assert run("--lift", "-1")[0] == run("--lift", "much")[0] == 2
assert "--lift BY" in CliRunner().invoke(main, ["recon", "--help-all"]).output
""",
)

EXTENSIONS = {"method": METHOD, "check": CHECK, "effect": EFFECT, "reader": READER, "stage": STAGE, "step": STEP}
