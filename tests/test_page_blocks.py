"""Each code block of README, and each Python block of a page, runs as printed, or is listed here with a reason."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import h5py
import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from beamline.config.load import config_folder

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "packages").glob("*/README.md"))]
SHELL_PAGES = ("README.md", "docs/python.md", "docs/first_day.md", "docs/tutorials.md")
"""Pages whose blocks without a language count, too; `tests/test_command_lines.py` parses those of all pages."""
WITHIN = 600.0  # s for a command; as a rule half a minute


@dataclass(frozen=True)
class Block:
    """A fenced block. page: below the root; example: the file that the page says it shows, or empty."""

    page: str
    language: str
    text: str
    example: str

    @property
    def key(self) -> tuple[str, str]:
        """The page and the block's first line."""
        return self.page, self.text.splitlines()[0]


def blocks_of(page: Path) -> list[Block]:
    """The fenced blocks of a page in order, also those that stand in a list."""
    text = page.read_text(encoding="utf-8")
    fences = re.findall(r"(?ms)(?:^<!-- (docs/examples/\S+) -->\n)?^( *)```(\w*)\n(.*?)^ *```$", text)
    assert text.count("```") == 2 * len(fences), page
    name = page.relative_to(ROOT).as_posix()
    return [Block(name, language, re.sub(f"(?m)^{pad}", "", body), shown) for shown, pad, language, body in fences]


BLOCKS = [block for page in PAGES for block in blocks_of(page)]

# The configuration that a page has from its operator: a small scan on a virtual clock.
CONFIGURED = f"""
from pathlib import Path
from beamline.config.load import load, resolved_yaml
Path("my.yaml").write_text(resolved_yaml(load(Path({str(config_folder() / "simulated.yaml")!r}), (
    "simulation.clock=virtual", "devices.camera.roi=[1144, 1968, 16, 96]", "scan.angles.views=60", "scan.period_s=1.0",
    "scan.darks.count=3", "scan.flats.count=3", "recon.live=false", "recon.seconds=1",
), {{}})))
"""
BALLS = """
import numpy as np
import recon
theta, cols, rows = np.linspace(0, np.pi, 60, endpoint=False), np.arange(256), np.arange(96)
places = ((30.0, 20.0, 40.0, 25.0), (-50.0, 10.0, 55.0, 15.0), (5.0, -60.0, 48.0, 20.0))  # x, y, row, radius in pixels
chords = [r**2 - (cols - 127.5 - (x * np.cos(theta) + y * np.sin(theta))[:, None, None]) ** 2 - (rows[:, None] - z) ** 2
          for x, y, z, r in places]
projections = sum(0.02 * np.sqrt(np.maximum(each, 0)) for each in chords).astype(np.float32)
"""
HASTY = """
made, advance = recon.R2, recon.StreamingFit.advance
recon.R2 = lambda seconds: made(seconds=seconds / 10)
recon.StreamingFit.advance = lambda fit, seconds: advance(fit, seconds=seconds / 10)
"""
"""The times that the page gives to its fits, shorter: what holds at the end holds after a tenth of them."""


@dataclass(frozen=True)
class Script:
    """Blocks of a page that run one after the other in one program.

    Attributes:
        page: below the root.
        first: the first line of each block.
        before: what the page takes as given.
        after: what must hold at the end.
        needs: a package that is not always there.
    """

    page: str
    first: tuple[str, ...]
    before: str
    after: str
    needs: str = "recon"


SCRIPTS = {
    "library": Script(
        "README.md", ("import numpy as np",), BALLS + HASTY,
        "assert abs(axis.value - 127.5) < 0.1 and axis.confident, axis\n"
        "again = recon.Reconstruction.load('volume.npz')\n"
        "assert np.array_equal(again.volume.data, result.volume.data) and again.volume.grid == result.volume.grid\n"
        "assert again.settings['rays'] == result.settings['rays'], again.settings\n"
        "assert result.history and result.gaussians.n and np.isfinite(result.volume.data).all()\n"
        "assert np.array_equal(recon.Reconstruction.load('so_far.npz').volume.data, fit.snapshot().data)\n"
        "import subprocess\n"
        "subprocess.run('beamline export volume.npz -o volume.tif'.split(), check=True)",
    ),
    "scan": Script(
        "docs/python.md", ("from beamline import api",), CONFIGURED,
        "assert (result.frames, result.sample, result.status) == (99, 'cathode-3', 'complete'), result",
    ),
    "plan": Script(
        "docs/python.md", ('plan = api.plan(["a.yaml", "tonight.csv", {"config": "b.yaml", "scan.exposure_s": 0.1}])',),
        CONFIGURED + "from beamline import api\n"
        "text = Path('my.yaml').read_text()\n"
        "Path('a.yaml').write_text(text)\n"
        "Path('b.yaml').write_text(text.replace('mode: fly', 'mode: flyy'))\n"
        "Path('tonight.csv').write_text('config,sample.name\\na.yaml,one\\n')\n",
        "assert [scan.valid for scan in plan.scans] == [True, True, False] and 'did you mean fly?' in str(fault)\n"
        "assert fault.file == 'b.yaml' and plan.needs.duration > 0",
    ),
    "bluesky": Script(
        "docs/python.md", ("from bluesky import RunEngine, plan_stubs", "from bluesky import plan_stubs, plans"),
        CONFIGURED, "assert len(list(Path('runs').iterdir())) >= 2", "ophyd_async",
    ),
}  # fmt: skip

ELSEWHERE = {
    (
        "README.md",
        "pip install --no-compile -c constraints.txt -e . && beamline demo",
    ): "the gate: .ci/wheel; the second line is one of those of FILES",
    ("README.md", 'pip install -c constraints.txt -e ".[dev]" && pytest -n auto'): "the gate: .ci/run",
    ("docs/tutorials.md", "pip install packages/splatline-structure"): "the gate: .ci/wheel",
    ("docs/tutorials.md", "beamline demo"): "the gate: .ci/wheel",
    ("docs/python.md", "bluesky-0MQ-proxy 5577 5578 &"): "tests/beamline/bluesky/test_zmq.py, at ports that are free",
    (
        "docs/energies.md",
        "views = recon.TimedViews(projections, geometry, times)  # [view, row, col]; one time a view",
    ): "tests/recon/features/joint/test_series.py, with weights of its own, whose choice takes minutes",
}
"""Blocks that other tests run."""

NOT_RUN = {
    ("docs/python.md", 'pip install "splatline[bluesky]"'): "installs from an index",
    ("docs/areadetector_publish.md", "from ophyd_async.epics.adcore import ADWriterFactory"): "asks an IOC; "
    "tests/bluesky_judge.py of the add-on does the same at one of its own",
    ("packages/splatline-cluster/README.md", "from dask_jobqueue import SLURMCluster"): "needs Slurm",
    ("packages/splatline-emission/README.md", "survival = efficiency * splatline_emission.attenuation_factors(mu, "
     "geometry)  # mu: a Volume of 1/mm at 511 keV"): "a part of a program, whose inputs are measured; the add-on's "
    "tests call the same",
    ("packages/splatline-tango/README.md", "from tango import DeviceProxy"): "asks a device of a running server",
    ("docs/first_day.md", "beamline config init --instrument > my.yaml   # every key, with comments"): "an instrument",
    ("docs/first_day.md", "beamline check my.yaml --connect              # connects to each device, prints its "
     "identity and its status; nothing moves"): "an instrument",
    ("docs/first_day.md", "beamline scan my.yaml --rehearse --set scan.angles.views=60 --set scan.period_s=0.5"):
    "minutes of frames of the whole detector",
    ("docs/first_day.md", "beamline tune my.yaml                         # counts, saturation, transmission, and the "
     "recommended exposure time"): "an instrument",
    ("docs/first_day.md", "beamline scan my.yaml --dry-run               # speed, blur, duration, size, free disk; "
     "nothing moves"): "an instrument",
    ("docs/first_day.md", "beamline recon runs/NAME/scan.h5 -m fbp --bin 4 -o quick.h5   # is the axis right, is the "
     "sample inside the field of view?"): "the names are the reader's",
    ("docs/tutorials.md", "beamline view runs/*_demo-battery/recon.h5"): "a viewer, until Ctrl-C",
    ("docs/tutorials.md", "beamline info SCAN.h5"): "the names are the reader's; README's block runs the same",
    ("docs/tutorials.md", "label,volume_um3,diameter_um,sphericity,z_um,y_um,x_um,cut,contacts,neighbours"): "a table",
}  # fmt: skip
"""Blocks that no test runs, and why. The command lines among them are parsed by their commands."""

INSTRUMENT = (
    "README.md",
    "beamline config init --instrument > my.yaml   # every key, with comments; edit ports, speeds, pixel size",
)
FILES = (
    "README.md",
    "beamline info SCAN.h5                         # what the file contains: frames, angles, flats and darks",
)
"""Blocks of command lines that run here."""


def _counts(block: Block) -> bool:
    return not block.example and (block.language == "python" or block.page in SHELL_PAGES) and block.language != "text"


def test_every_block_is_run_or_listed_with_the_reason() -> None:
    scripts = {(script.page, first) for script in SCRIPTS.values() for first in script.first}
    known = [*scripts, *ELSEWHERE, *NOT_RUN, INSTRUMENT, FILES]
    found = [block.key for block in BLOCKS if _counts(block)]
    assert len(known) == len(set(known)) and len(found) == len(set(found))
    assert {"new": set(found) - set(known), "gone": set(known) - set(found)} == {"new": set(), "gone": set()}
    for key, where in ELSEWHERE.items():
        assert any((ROOT / word.strip(",:;")).exists() for word in where.split()), (key, where)


@pytest.mark.parametrize(
    "block", [each for each in BLOCKS if each.language == "python"], ids=lambda block: block.key[1][:40]
)
def test_every_block_is_python(block: Block) -> None:
    compile(block.text, block.page, "exec")


def _run(command: list[str] | str, folder: Path) -> str:
    """What a command prints, in the folder, with this environment's programs first; it must succeed."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
    one_thread = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}  # two would use twice the time of processors
    environment = {**os.environ, **one_thread, "PATH": path, "MPLBACKEND": "agg"}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, encoding="utf-8", timeout=WITHIN,
        shell=isinstance(command, str), check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{command}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    return done.stdout


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", SCRIPTS)
def test_blocks_of_python_run_as_they_are_printed(name: str, tmp_path: Path) -> None:
    script = SCRIPTS[name]
    if find_spec(script.needs) is None:
        pytest.skip(f"could not find {script.needs!r}")
    texts = {block.key: block.text for block in BLOCKS}
    parts = [script.before, *(texts[script.page, first] for first in script.first), script.after]
    (tmp_path / "block.py").write_text("\n".join(parts) + "\n", encoding="utf-8")
    _run([sys.executable, "block.py"], tmp_path)


def _lines(key: tuple[str, str]) -> list[str]:
    (block,) = (each for each in BLOCKS if each.key == key)
    return block.text.splitlines()


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.skipif(sys.platform == "win32", reason="the lines are those of a POSIX shell")
def test_the_first_scan_of_readme_runs_as_it_is_printed(tmp_path: Path) -> None:
    """The operator edits the file that the first line makes; here the instrument is a simulated one."""
    made, *others = _lines(INSTRUMENT)
    _run(made, tmp_path)
    assert "port" in (tmp_path / "my.yaml").read_text(encoding="utf-8")
    _run([sys.executable, "-c", CONFIGURED.replace("live=false", "live=true")], tmp_path)
    for line in others:
        _run(line, tmp_path)
    (run,) = (tmp_path / "runs").iterdir()
    assert {"scan.h5", "recon.h5", "report.html"} <= {path.name for path in run.iterdir()}


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.skipif(sys.platform == "win32", reason="the lines are those of a POSIX shell")
def test_the_first_reconstruction_of_readme_runs_as_it_is_printed(tmp_path: Path) -> None:
    *lines, view = _lines(FILES)
    for name, rows in (("small", 8), ("tall", 760)):
        words = ["--frames", "100", "--set", f"detector.shape=[{rows},32]", "--out", str(tmp_path / f"{name}.h5")]
        assert CliRunner().invoke(main, ["simulate", "battery", *words]).exit_code == 0
    for line in lines:
        kind = "tall" if "--rows 500:756" in line else "small"
        shutil.copy(tmp_path / f"{kind}.h5", tmp_path / "SCAN.h5")
        _run(line, tmp_path)
    with h5py.File(tmp_path / "OUT.h5") as file:
        assert file["entry/data/data"].shape[0] == 128 and file["entry/reconstruction/parameters/n_views"][()] == 90
    with subprocess.Popen(
        [sys.executable, "-m", "beamline.cli.main", *shlex.split(view, comments=True)[1:]],
        cwd=tmp_path, stdout=subprocess.PIPE, text=True, encoding="utf-8",
    ) as viewer:  # fmt: skip
        assert viewer.stdout is not None
        address = next(word for word in viewer.stdout.readline().split() if word.startswith("http://"))
        with suppress(urllib.error.HTTPError):  # without its cookie: it serves, so that Ctrl-C is its ordinary end
            urllib.request.urlopen(address).close()
        viewer.send_signal(signal.SIGINT)
        try:
            assert viewer.wait(60) == 0
        finally:
            viewer.kill()
