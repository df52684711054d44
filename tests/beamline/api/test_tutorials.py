"""The scripts in docs/tutorials.md run unchanged, and the page shows what they print and draw.

`python -m tests.beamline.api.test_tutorials` writes texts and pictures of the page anew; look at them.
"""

import io
import re
import runpy
import shutil
import sys
from collections.abc import Callable
from contextlib import chdir, redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from beamline.config.load import config_folder

EXAMPLES = Path(__file__).parents[3] / "docs" / "examples"
SHOWN = EXAMPLES / "outputs"
NUMBER = re.compile(r"\d+(?:\.\d+)?")


def my_yaml(folder: Path) -> list[str]:
    """A configuration with simulated devices on a virtual clock."""
    template = (config_folder() / "simulated.yaml").read_text(encoding="utf-8")
    (folder / "my.yaml").write_text(template.replace("clock: real ", "clock: virtual "), encoding="utf-8")
    return ["my.yaml"]


def scan_and_truth(folder: Path) -> list[str]:
    """Files of a simulated scan and of its truth."""
    words = ["--frames", "120", "--set", "detector.shape=[4,160]", "--out", "scan.h5", "--truth", "truth.h5"]
    assert CliRunner().invoke(main, ["simulate", "cathode", *words]).exit_code == 0
    return ["scan.h5", "truth.h5"]


TUTORIALS: dict[str, Callable[[Path], list[str]]] = {
    "first_reconstruction": my_yaml,
    "cost_of_accuracy": scan_and_truth,
    "streaming": lambda folder: scan_and_truth(folder)[:1],
}


def printed(name: str, folder: Path) -> str:
    """What a tutorial prints; its picture is NAME.png in the folder."""
    out, before = io.StringIO(), sys.argv
    mpl.use("Agg")
    with chdir(folder):
        sys.argv = [f"{name}.py", *TUTORIALS[name](folder)]
        try:
            with redirect_stdout(out):
                runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        finally:
            sys.argv = before
            plt.close("all")
    return out.getvalue()


def words(text: str) -> str:
    """The text without its numbers."""
    return NUMBER.sub("N", re.sub(" +", " ", text))


def figures(text: str) -> list[float]:
    return [float(number) for number in NUMBER.findall(text)]


def grey(path: Path) -> np.ndarray:
    """A picture in blocks of 8 x 8 pixels, from 0 to 1: letters may be drawn otherwise."""
    image = plt.imread(path)[..., :3].mean(2)
    rows, cols = (n // 8 * 8 for n in image.shape)
    return image[:rows, :cols].reshape(rows // 8, 8, cols // 8, 8).mean((1, 3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "steady", "apart"),
    [
        ("first_reconstruction", slice(None), 0.01),
        pytest.param(
            "cost_of_accuracy", slice(-1), 0.01, marks=pytest.mark.long
        ),  # the last figure of a line is a time
        ("streaming", slice(0), 0.05),  # a fit of so many seconds comes further on a faster machine
    ],
)
def test_the_page_shows_what_a_tutorial_prints_and_draws(
    name: str, steady: slice, apart: float, tmp_path: Path
) -> None:
    now, shown = printed(name, tmp_path), (SHOWN / f"{name}.txt").read_text(encoding="utf-8")
    assert words(now) == words(shown)
    for line, before in zip(now.splitlines(), shown.splitlines(), strict=True):
        np.testing.assert_allclose(figures(line)[steady], figures(before)[steady], rtol=0.05, atol=0.1)
    assert np.abs(grey(tmp_path / f"{name}.png") - grey(SHOWN / f"{name}.png")).mean() < apart


if __name__ == "__main__":
    SHOWN.mkdir(exist_ok=True)
    for tutorial in TUTORIALS:
        with TemporaryDirectory() as place:
            text = printed(tutorial, Path(place))
            (SHOWN / f"{tutorial}.txt").write_text(text, encoding="utf-8")
            shutil.copyfile(Path(place) / f"{tutorial}.png", SHOWN / f"{tutorial}.png")
            print(text)
