"""Films of volumes and of views."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from beamline.core.errors import ConfigError, DataError
from beamline.features.export import film_file as film
from beamline.features.export.film_file import FilmStyle, slices_along, thinned, views_by_angle, write_film
from beamline.storage.volumes.base import bare_record
from recon.base.greys import matter_window
from tests.beamline.array_source import ArraySource

VOLUME = np.random.default_rng(3).random((7, 9, 11)).astype(np.float32)
GREYS = np.rint(255 * VOLUME).astype(int)
WINDOW = 0.0, 1.0


def made(path: Path, axis: int, style: FilmStyle, spacing: tuple[float, float, float] = (1, 1, 1)) -> np.ndarray:
    path.touch()
    record = bare_record(path, VOLUME, spacing)
    path.unlink()
    shown = write_film(path, slices_along(record, axis, style.side), style, lambda n, of: None)
    with Image.open(path) as gif:
        images = np.stack([np.asarray(image.convert("L"), int) for image in ImageSequence.Iterator(gif)])
        assert gif.info["duration"] == pytest.approx(1000 / shown.fps)
    assert images.shape == (shown.images, *shown.shape)
    return images


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("held", [1, 2**20])
def test_a_film_shows_every_slice_along_its_axis(
    tmp_path: Path, axis: int, held: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(film, "HELD_BYTES", held)
    images = made(tmp_path / "f.gif", axis, FilmStyle(window=WINDOW, fps=40))
    np.testing.assert_array_equal(images, np.moveaxis(GREYS, axis, 0))


@pytest.mark.parametrize("axis", range(3))
def test_pixels_are_averaged_and_slices_as_far_apart_as_they_are(tmp_path: Path, axis: int) -> None:
    images = made(tmp_path / "f.gif", axis, FilmStyle(side=16, window=WINDOW), spacing=(4, 1, 1))
    whole = np.moveaxis(VOLUME, axis, 0)
    shape = whole.shape[1:] if axis == 0 else (16, round(whole.shape[2] * 16 / 28))
    assert images.shape[1:] == shape
    assert images.mean() / 255 == pytest.approx(VOLUME.mean(), abs=0.01)


def test_of_many_slices_every_second_or_third_is_shown() -> None:
    assert list(thinned(600)) == list(range(600)) and list(thinned(1201)) == list(range(0, 1201, 3))


def test_the_grey_window_is_that_of_matter_and_nan_is_black(tmp_path: Path) -> None:
    values = VOLUME.copy()
    values[3, 4, 5] = np.nan
    (tmp_path / "v").touch()
    images = slices_along(bare_record(tmp_path / "v", values), 0, 64)
    shown = write_film(tmp_path / "f.gif", images, FilmStyle(), lambda n, of: None)
    assert shown.window == pytest.approx(matter_window(values))
    with Image.open(tmp_path / "f.gif") as gif:
        gif.seek(3)
        assert gif.convert("L").getpixel((5, 4)) == 0


def test_nothing_is_left_of_a_film_that_ended_early(tmp_path: Path) -> None:
    def interrupt(n: int, of: int) -> None:
        raise KeyboardInterrupt

    (tmp_path / "v").touch()
    images = slices_along(bare_record(tmp_path / "v", VOLUME), 0, 64)
    with pytest.raises(KeyboardInterrupt):
        write_film(tmp_path / "f.gif", images, FilmStyle(), interrupt)
    flat = slices_along(bare_record(tmp_path / "v", np.ones((2, 3, 4), np.float32)), 0, 64)
    with pytest.raises(ConfigError, match="is 1, or not finite: give --window"):
        write_film(tmp_path / "f.gif", flat, FilmStyle(), lambda n, of: None)
    assert [path.name for path in tmp_path.iterdir()] == ["v"]


@pytest.mark.skipif(sys.platform == "win32", reason="the stand-in of ffmpeg is a shell script")
def test_ffmpeg_gets_every_image_and_its_complaint_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "ffmpeg"
    monkeypatch.setattr(film.shutil, "which", lambda name: str(program))
    (tmp_path / "v").touch()
    images, style = slices_along(bare_record(tmp_path / "v", VOLUME), 0, 64), FilmStyle(window=WINDOW)
    program.write_text('#!/bin/sh\nfor last; do :; done\ncat > "$last"\n')
    program.chmod(0o755)
    write_film(tmp_path / "f.mp4", images, style, lambda n, of: None)
    np.testing.assert_array_equal(np.fromfile(tmp_path / "f.mp4", np.uint8).reshape(VOLUME.shape), GREYS)
    program.write_text("#!/bin/sh\necho no codec >&2; exit 3\n")
    with pytest.raises(DataError, match="no codec"):
        write_film(tmp_path / "g.mp4", images, style, lambda n, of: None)
    monkeypatch.setattr(film.shutil, "which", lambda name: None)
    with pytest.raises(ConfigError, match=r"name a \.gif"):
        write_film(tmp_path / "g.mp4", images, style, lambda n, of: None)
    assert not list(tmp_path.glob("*g.mp4*"))


def images_of(views: int, damaged: set[int]) -> list[float]:
    light = np.array([100, 1100] + [600] * views, np.uint16)  # a dark, a flat, and the views
    frames = np.broadcast_to(light[:, None, None], (light.size, 6, 8)).copy()
    source = ArraySource(frames, [2, 1] + [0] * views, np.array([0, 0, *range(views, 0, -1)], np.float64))
    source.damaged = frozenset(damaged)
    return [float(image.mean()) for image in views_by_angle(source, 64, lambda sentence: None).read()]


def test_a_damaged_view_is_left_out() -> None:
    assert images_of(3, damaged={3}) == pytest.approx([np.log(2)] * 2, abs=1e-5)


def test_a_scan_without_a_usable_view_is_refused() -> None:
    with pytest.raises(DataError, match="can be used"):
        images_of(2, damaged={2, 3})
