"""The registry of methods: a name is its object, and one line makes a method known everywhere."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from recon import methods
from recon.base.method import Method, Traits
from recon.splatting.stream import StreamingMethod
from recon.voxels.projector import Projector

ROOT = Path(__file__).parents[2]
VIEWS = recon.Geometry.parallel(np.linspace(0, np.pi, 12, endpoint=False), (6, 24), 0.5)


@pytest.fixture(scope="module")
def projections() -> NDArray[np.float32]:
    grid = recon.Grid.matching(VIEWS)
    truth = np.zeros(grid.shape, np.float32)
    truth[1:5, 8:15, 6:13] = 0.2
    return Projector(VIEWS, grid).forward(truth)


@pytest.mark.parametrize("name", methods.names())
def test_a_method_by_name_is_the_method_by_object_to_the_bit(name: str, projections: NDArray[np.float32]) -> None:
    method = methods.by_name(name)
    by_name, by_object = (recon.reconstruct(projections, VIEWS, given, seed=3) for given in (name, method()))
    np.testing.assert_array_equal(by_name.volume.data, by_object.volume.data)
    assert by_name.method == by_object.method == method.name == name
    assert by_object.volume.data.max() > 0.05


@pytest.mark.parametrize("name", methods.names())
def test_what_the_registry_says_is_what_the_class_is(name: str) -> None:
    method = methods.by_name(name)
    assert method.name == name and method.label and method.colour
    assert is_dataclass(method) and getattr(recon, method.__name__) is method
    assert methods.streams(name) is isinstance(method(), StreamingMethod)
    assert len({methods.by_name(other).colour for other in methods.names()}) == len(methods.names())


@pytest.mark.parametrize("name", methods.names())
@pytest.mark.parametrize("depth", ["quick", "full"])
def test_every_trial_is_settings_that_the_method_has(name: str, depth: str) -> None:
    method = methods.by_name(name)
    base, *others = method.trials(5000, depth)  # type: ignore[arg-type]
    assert base.varies == "method" and base.binning == 1
    for tried in (base, *others):
        built = methods.build(method, tried.settings)
        assert isinstance(built, method) and built.work(60, tried.binning) > 0
    assert methods.build(method, base.settings).toy().work(60, 1) <= methods.build(method, base.settings).work(60, 1)


def test_settings_are_built_by_name() -> None:
    built = methods.build(recon.R2, {"steps": 5, "fit.loss": "l2", "fit.truncation.sigmas": 3.0})
    assert isinstance(built, recon.R2)
    assert (built.steps, built.fit.loss, built.fit.truncation.sigmas) == (5, "l2", 3.0)
    assert built.fit.ssim_weight == recon.R2().fit.ssim_weight
    assert methods.taking("tv_weight") == ("fista-tv", "os-sirt-tv")
    assert methods.taking("fit.loss") == ("r2",)
    assert "iterations" not in {f.name for f in fields(recon.R2)}
    with pytest.raises(ValueError, match=r"'sirt' has no setting 'tv_weight' \(fista-tv, os-sirt-tv has\)"):
        methods.build(recon.Sirt, {"tv_weight": 0.1})
    with pytest.raises(ValueError, match=r"'sirt' has no setting 'magic' \(no method has\)"):
        methods.build(recon.Sirt, {"magic": 0.1})


def test_an_unknown_name_is_refused_with_the_legal_ones() -> None:
    for look in (methods.by_name, methods.streams):
        with pytest.raises(ValueError, match=r"method must be one of r2, fbp, .*os-sirt-tv, got 'art'"):
            look("art")


def test_every_trait_is_asked_somewhere() -> None:
    assert methods.with_trait("direct") == ("fbp",)
    for trait in (f.name for f in fields(Traits)):
        assert methods.with_trait(trait)


def test_names_load_nothing_that_computes() -> None:
    code = "import sys, recon.methods as m; m.names(); m.streams('r2'); print({'torch', 'numba'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


_DUMMY = '''
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from recon.base.method import MethodResult, Traits, TrialSettings
from recon.base.volume import Volume


@dataclass(frozen=True)
class Grey:
    """A method that finds everything equally grey."""

    name: ClassVar[str] = "grey"
    label: ClassVar[str] = "Grey"
    colour: ClassVar[str] = "grey"
    traits: ClassVar[Traits] = Traits(direct=True)

    iterations: int = 1
    shade: float = 0.5

    def run(self, problem, control):
        return MethodResult(Volume(np.full(problem.grid.shape, self.shade, np.float32), problem.grid), {})

    def toy(self):
        return self

    @classmethod
    def trials(cls, gaussians, depth):
        return [TrialSettings("method"), TrialSettings("shade", {"shade": 0.7})]

    def work(self, n_views, binning):
        return 1.0
'''
_USE = """
import numpy as np
import recon
from recon import methods
methods.REGISTRY["grey"] = methods.Entry("grey_method", "Grey")

from click.testing import CliRunner
from beamline.cli.recon import recon as command
from beamline.cli.tradeoff import tradeoff
from beamline.tradeoff.figures import pareto_plot
from beamline.tradeoff.trials import plan
from beamline.cli.method_options import takers
from beamline.reconstruct.recon_report import label_of

views = recon.Geometry.parallel([0.0, 1.0], (2, 3))
assert (recon.reconstruct(np.ones((2, 2, 3)), views, "grey").volume.data == 0.5).all()
white = methods.build(methods.by_name("grey"), {"shade": 1.0})
assert (recon.reconstruct(np.ones((2, 2, 3)), views, white).volume.data == 1).all()
trials = plan(("grey", "fbp"), 60, 1000, "quick")
labels = {t.label for t in trials if t.method == "grey"}
assert labels == {"grey, 60 views", "grey, 30 views", "grey, 60 views, shade 0.7"}
assert pareto_plot([(t, 1.0, 20.0) for t in trials], [0], "s", "dB").startswith(b"\\x89PNG")
for offered in (command, tradeoff):
    assert "grey" in CliRunner().invoke(offered, ["--help"]).output
assert "grey" in takers("iterations") and "grey" not in takers("tv_weight")
assert label_of("grey") == "Grey"
print("known everywhere")
"""


def test_a_new_method_takes_its_file_and_one_line(tmp_path: Path) -> None:
    """In a process of its own, where the line is there before anything else is imported."""
    (tmp_path / "grey_method.py").write_text(_DUMMY, encoding="utf-8")
    code = f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(ROOT)!r}]\n{_USE}"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "known everywhere", done.stderr[-2000:]


def test_the_protocol_is_met_by_every_method() -> None:
    wanted = set(Method.__annotations__) | {"run", "toy", "trials", "work"}
    for name in methods.names():
        assert wanted <= set(vars(methods.by_name(name)))  # of its own: nothing is inherited
