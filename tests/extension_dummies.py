"""Dummy extensions of each kind: their files, registry lines, and a program that proves that they work.

Except for the stage, they are those of the site package (tests/site), each in the place of one of ours.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

SITE = Path(__file__).parent / "site" / "site_of_an_instrument"


@dataclass(frozen=True)
class Extension:
    """An extension.

    Attributes:
        files: its files, by path.
        lines: additions to registries: path, the line above, and the new line.
        proof: a program that ends without an error only if the dummy works.
    """

    files: Mapping[str, str]
    lines: tuple[tuple[str, str, str], ...]
    proof: str


def site(module: str) -> str:
    return (SITE / f"{module}.py").read_text(encoding="utf-8")


METHOD = Extension(
    {"recon/voxels/mean.py": site("methods")},
    (
        (
            "recon/methods.py",
            '    "fbp": MethodEntry("recon.voxels.direct", "Fbp"),',
            '    "mean": MethodEntry("recon.voxels.mean", "Mean"),',
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

from recon.voxels import mean

mean.direct = lambda views, geometry, grid, name: np.full(grid.shape, {"ram-lak": 3, "hann": 1}[name])
views, data = recon.Geometry.parallel([0.0, 1.0], (2, 3)), np.ones((2, 2, 3))
for method in ("mean", recon.Mean()):
    assert (recon.reconstruct(data, views, method).volume.data == 2).all()
sharp = methods.build(methods.by_name("mean"), {"share": 1.0})
assert (recon.reconstruct(data, views, sharp).volume.data == 3).all()
trials = plan(("mean", "fbp"), 60, "quick")
labels = {t.label for t in trials if t.method == "mean"}
assert labels == {"mean, 60 views", "mean, 30 views"}, labels
for offered in (command, tradeoff):
    assert "mean" in CliRunner().invoke(offered, ["--help"]).output
assert "mean" in taking("share") and "mean" not in taking("tv_weight")
assert label_of("mean") == "Mean of two"
""",
)

CHECK = Extension(
    {"beamline/monitor/half.py": site("checks")},
    (("beamline/monitor/checks.py", '    "DarkCheck": "frames",', '    "Half": "half",'),),
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
    load(path, ["monitor.half.share=0"], {})
except ConfigError as error:
    refused = str(error)
config, flags = load(path, [*words, "monitor.half.share=0.99"], {}), []
sinks = [lambda event: flags.append(event.data.get("check"))]
result = run_scan(config, Path("runs"), sinks)
with h5py.File(result.path) as file:
    legend = file["entry/frame_log/flag_legend"]
    row = list(legend["name"].asstr()[()]).index("half")
    said = [int(legend[name][row]) for name in ("bit", "alarm_bit")]
    said += [legend[name].asstr()[row] for name in ("unit", "meaning")]
    bits = [int(b) & (1 << 47 | 1 << 63) for b in file["entry/frame_log/flags"][()]]
info = describe(result.path)["flags"]
assert "monitor.half.share is 0; expected a number > 0" in refused, refused
assert result.flags["half"] == {"warn": 6} and "half" in flags, result.flags
assert said == [47, 63, "share", "the frame has far less light than one before it"], said
assert bits == [0] * 4 + [1 << 47] * 6, bits
assert info["half"] == {"warn": 6}
""",
)

EFFECT = Extension(
    {"simulators/effects/dimmed.py": site("effects")},
    (
        (
            "simulators/effects/catalogue.py",
            '        "photon_noise": _sensor(Domain.PHOTONS, "photons arrive at random"),',
            '        "dimmed": EffectRow(Domain.PHOTONS, "half of the light", module="simulators.effects.dimmed"),',
        ),
    ),
    """
import numpy as np
from tests.simulators import shots
from tests.simulators.effects.on_demand import shot
from simulators.scenes.expose import expose

whole, half = (expose(shots.scene(*effects, flux=4000.0), shot(1)) for effects in ((), ({"kind": "dimmed"},)))
assert whole.mean() > 100
np.testing.assert_allclose(half, whole / 2, atol=1)
""",
)

READER = Extension(
    {"beamline/storage/readers/npy_stack.py": site("readers")},
    (
        (
            "beamline/storage/readers/formats.py",
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
from beamline.scan.dry_run import dry_run
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
    {"beamline/projections/corrections/lift.py": site("corrections")},
    (("beamline/projections/registry.py", '    "Width": "corrections.width",', '    "Lift": "corrections.lift",'),),
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
from beamline.projections.views import select
from beamline.storage.readers.open import SourceOptions, open_scan
from tests.beamline.scans import TwoCylinders, write_exchange

path = write_exchange(Path("lift.h5"), TwoCylinders(shape=(2, 40)))
with open_scan(SourceOptions(path)) as source:
    chosen = [Selection(axis_col=20.7, steps=(Air("none"), *steps)) for steps in ((), (Lift(0.5),))]
    plain, lifted = (prepare_projections(select(source, each), print) for each in chosen)
np.testing.assert_allclose(lifted.seen.data, plain.seen.data + 0.5, atol=1e-6)
assert lifted.origin.done["lift"].sentence == "Lifted by 0.5."
found = recorded(in_order(chosen[1]), lifted.origin.done)
assert (found["lift"], found["lift_said"]) == (0.5, "Lifted by 0.5.")

def run(*options):
    done = CliRunner().invoke(main, ["recon", "lift.h5", "-m", "r2", "--axis", "20.7", *options])
    return done.exit_code, done.output

assert "lift: 0.5" in run("--lift", "0.5", "--write-config", "-")[1]
Path("recipe.yaml").write_text("method: r2\\nlift: 0.7\\n")
assert "lift: 0.7" in run("--config", "recipe.yaml", "--write-config", "-")[1]
code, said = run("--lift", "1", "--follow")
assert code == 2 and "--lift is for a finished scan" in said
assert run("--lift", "much")[0] == 2
assert "--lift BY" in CliRunner().invoke(main, ["recon", "--help-all"]).output
""",
)

EXTENSIONS = {"method": METHOD, "check": CHECK, "effect": EFFECT, "reader": READER, "stage": STAGE, "step": STEP}
