"""The notebooks run, in less than 90 s of CPU, and their progress is lines; an interrupted cell leaves whole files."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

jupytext = pytest.importorskip("jupytext", reason="jupytext is not installed: pip install '.[docs]'")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed: pip install '.[docs]'")
pytest.importorskip("ipykernel", reason="ipykernel is not installed: pip install '.[docs]'")
resource = pytest.importorskip("resource", reason="the CPU time of kernels is measured on POSIX systems alone")

from jupyter_client.manager import KernelManager  # noqa: E402

from beamline.cli.terminal import NOTEBOOK  # noqa: E402
from beamline.storage.volumes.files import whole_volume  # noqa: E402
from tests.beamline.scans import TwoCylinders, write_exchange  # noqa: E402

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.py"))
WITHIN = 90.0  # s of CPU; on two cores the time is less
PICTURES = {"first_reconstruction": 4, "others_scans": 2, "operando_series": 3}
"""Figures and values that show themselves, at least."""

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning", "ignore::UserWarning")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder of kernels, which find the packages and the commands of this checkout."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setenv("PATH", os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"])))
    return tmp_path


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return float(used.ru_utime + used.ru_stime)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_pictures(path: Path, here: Path) -> None:
    notebook = jupytext.read(path)
    before = _cpu()
    nbclient.NotebookClient(notebook, kernel_name="python3", timeout=200).execute()
    assert _cpu() - before < WITHIN
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    texts = "".join(str(output.get("text", "")) for output in outputs)
    assert not re.search(r"\r(?!\n)|\x1b|\\x1b", texts)  # a bar redraws its line
    shown = [output.get("data", {}) for output in outputs]
    pictures = [data for data in shown if "image/png" in data or "data:image/png" in str(data.get("text/html"))]
    assert len(pictures) >= PICTURES[path.stem]


def test_there_is_a_count_of_pictures_of_each_notebook() -> None:
    assert {path.stem for path in NOTEBOOKS} == set(PICTURES)


@pytest.fixture
def kernel(here: Path) -> Iterator[tuple[KernelManager, Any]]:
    manager = KernelManager(kernel_name="python3")
    manager.start_kernel(cwd=str(here))
    client = manager.client()
    client.start_channels()
    client.wait_for_ready(timeout=120)
    yield manager, client
    client.stop_channels()
    manager.shutdown_kernel(now=True)


def _interrupted(kernel: tuple[KernelManager, Any], code: str, begun: Callable[[str], bool], times: int) -> str:
    """The texts of a cell that is interrupted `times` times once its output says that it has `begun`."""
    manager, client = kernel
    cell = client.execute(code)
    text, left, end = "", times, time.monotonic() + 180
    while time.monotonic() < end:
        message = client.get_iopub_msg(timeout=120)
        if message["parent_header"].get("msg_id") != cell:
            continue
        kind, content = message["msg_type"], message["content"]
        text += content.get("text", "") + "\n".join(content.get("traceback", ()))
        if kind == "status" and content["execution_state"] == "idle":
            assert left < times or not times, text
            return text
        if left and kind == "stream" and begun(text):
            manager.interrupt_kernel()
            left -= 1
            time.sleep(0.5)
    raise AssertionError(text)


def _names(folder: Path) -> set[str]:
    """The files in the folder of a kernel, also hidden ones, without the temporary files of the kernel itself."""
    return {path.name for path in folder.iterdir() if not path.name.startswith(("tmp", "matplotlib"))}


CALL = """
import recon
from beamline import api
def say(text):
    print(text, flush=True)
method = recon.FistaTv(iterations=100_000, still=0.0, tv_weight=1e-4)
record = api.reconstruct("scan.h5", method, output="volume.h5", say=say)
"""


@pytest.mark.parametrize("times", [1, 2])
def test_an_interrupted_call_leaves_a_whole_volume_or_none(
    kernel: tuple[KernelManager, Any], here: Path, times: int
) -> None:
    write_exchange(here / "scan.h5", TwoCylinders())
    said = _interrupted(kernel, CALL, lambda text: "fista-tv starts" in text, times)
    names = _names(here)
    if "KeyboardInterrupt" in said:
        assert names == {"scan.h5"}
    else:
        assert names == {"scan.h5", "volume.h5", "volume.html"}
        assert np.isfinite(whole_volume(here / "volume.h5")[0]).all()


def test_an_interrupted_command_leaves_no_part_of_a_file(kernel: tuple[KernelManager, Any], here: Path) -> None:
    write_exchange(here / "scan.h5", TwoCylinders())
    command = "!beamline recon scan.h5 -m fista-tv --iterations 100000 --tv-weight 1e-4 -o volume.h5"
    _interrupted(kernel, command, lambda text: "volume:" in text or "starts" in text, 1)
    whole = {"scan.h5"}, {"scan.h5", "volume.h5", "volume.html"}
    deadline = time.monotonic() + 20  # the notebook may be free before the command has written its report
    while _names(here) not in whole and time.monotonic() < deadline:
        time.sleep(0.1)
    assert _names(here) in whole


INTERRUPTED = {
    "first_reconstruction": ("!beamline recon ", "fista-tv starts"),
    "others_scans": ("!beamline sweep ", "trials: 0/5"),
    "operando_series": ("!{queue}\n", "Scan 2 of 4"),
}
"""A cell of each notebook, and the text of its output after which the kernel is interrupted."""


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_an_interrupted_cell_of_a_notebook_leaves_whole_files_and_runs_again(
    path: Path, kernel: tuple[KernelManager, Any], here: Path
) -> None:
    cell, begun = INTERRUPTED[path.stem]
    sources = [f"{each['source']}\n" for each in jupytext.read(path).cells if each["cell_type"] == "code"]
    (place,) = (n for n, source in enumerate(sources) if cell in source)
    for source in sources[:place]:
        _interrupted(kernel, source, lambda text: False, 0)
    said = _interrupted(kernel, sources[place], lambda text: begun in text, 1)
    assert begun in said
    (prefix,) = re.findall(r'mkdtemp\(prefix="(.*)"', path.read_text(encoding="utf-8"))
    (folder,) = here.glob(f"{prefix}*")
    files = [each for each in folder.rglob("*") if each.is_file()]
    assert not [each for each in files if each.name.startswith(".") or each.suffix in (".partial", ".new")], said
    for each in files:
        if each.suffix == ".h5":
            h5py.File(each).close()
    again = _interrupted(kernel, sources[place], lambda text: False, 0)
    assert "beamline: " not in again and "Traceback" not in again, again


def test_a_cell_gets_lines_in_place_of_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    from beamline.cli.terminal import Terminal

    monkeypatch.setenv("FORCE_COLOR", "1")  # as a kernel sets it
    monkeypatch.setenv(NOTEBOOK, "1")
    assert Terminal(sys.stderr)._bar.disable
