"""YAML: files that would take long to parse are rejected at once; errors are in words, with the line to fix."""

import time
from pathlib import Path

import pytest

from beamline.config import tree
from beamline.config.load import config_folder
from beamline.config.tree import override, read
from beamline.core.errors import ConfigError
from beamline.scenes.scene_file import open_scene
from tests.beamline.cli.small_scan import beamline

LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join(9 * [f'*{before}'])}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
MERGED = "a: &a {x: 1}\n" + "".join(
    f"{name}: &{name} {{<<: [{', '.join(9 * [f'*{before}'])}]}}\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
ATTACKS = {
    "aliases": LAUGHS,
    "merged aliases": MERGED,
    "sexagesimal": f"a: {':'.join(100_000 * '1')}\n",
    "sexagesimal fraction": f"a: {':'.join(20_000 * '1')}.5\n",
    "digits": f"a: {2_000_000 * '9'}\n",
    "hexadecimal": f"a: 0x{200_000 * 'f'}\n",
    "groups": f"a: {5000 * '['}\n",
    "keys": "".join(f"k{n}: 1\n" for n in range(30_000)),
}


@pytest.mark.parametrize("name", ATTACKS)
def test_what_would_take_long_is_refused_at_once(name: str) -> None:
    begin = time.process_time()
    with pytest.raises(ConfigError, match=r"my\.yaml(:\d+)?: .*settings are too large"):
        read(ATTACKS[name], "my.yaml")
    assert time.process_time() - begin < 1.5  # a third of that on an idle core


def test_overrides_scenes_and_recipes_are_read_alike(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="settings are too large"):
        override(read("a: 1\n", "my.yaml"), [f"a={':'.join(1000 * '1')}"], {})
    path = tmp_path / "it.yaml"
    path.write_text(LAUGHS)
    with pytest.raises(ConfigError, match="settings are too large"):
        open_scene(str(path))
    path.write_text("method: {a: fbp\nrings: vo\n")
    said = " ".join(beamline("recon", "scan.h5", "--config", path).stderr.split())
    assert "it.yaml:1: this is not YAML (the { of this line is never closed)" in said
    path.write_text("a: " + 100 * "[")
    assert "settings are too large" in beamline("recon", "scan.h5", "--config", path).stderr


def test_both_loaders_read_the_same_values_and_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    texts = [path.read_text("utf-8") for path in config_folder().rglob("*.yaml")]
    texts += [
        "a: [1, 2.5, .nan, 2024-02-30, 0x10, 012, yes, ~]\nb: |\n  x\n  y\nc: 'it''s'\n",
        "a: {b: &x [1], c: *x}\n",
    ]
    fast = [read(text, "my.yaml") for text in texts]
    monkeypatch.setattr(tree, "_FastLoader", tree._Loader)
    tree._read.cache_clear()
    assert repr([read(text, "my.yaml") for text in texts]) == repr(fast)


@pytest.mark.parametrize("text", ["a:\t1\n", "a: [1,\t2]\n", "\ta: 1\n", "a: {b: 1,\nc", "a: *none\n"])
def test_what_one_loader_takes_and_the_other_does_not_has_the_fault_of_the_strict_one(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def said() -> str:
        try:
            return repr(read(text, "my.yaml"))
        except ConfigError as error:
            return str(error)

    both = said()
    monkeypatch.setattr(tree, "_FastLoader", tree._Loader)
    tree._read.cache_clear()
    assert said() == both


def test_what_is_read_again_is_as_it_was_read_first() -> None:
    first = read("a: {b: [1]}\n", "my.yaml")
    first.data["a"]["b"].append(2)
    assert read("a: {b: [1]}\n", "my.yaml").data == {"a": {"b": [1]}}
    assert read("a: {b: [1]}\n", "other.yaml").origin(("a",)) == "other.yaml:1"


def test_dates_aliases_and_long_texts_of_a_person_are_read() -> None:
    assert read("name: 2024-02-30\n", "my.yaml").data["name"] == "2024-02-30"
    text = f"beam: &beam {{energy: 25}}\nother: {{<<: *beam, name: '{5000 * 'x'}'}}\ntime: 1:30\n"
    assert read(text, "my.yaml").data["other"]["energy"] == 25 and read(text, "my.yaml").data["time"] == 90


FAULTS = {
    "tab": ("scan:\n\tmode: step\n", 2, "this line begins with a tab"),
    "tab below": ("scan:\n  mode: step\n\tviews: 3\n", 3, "this line begins with a tab"),
    "brace": ("a: 1\nscan: {mode: step\nsample:\n  name: {x: 1}\n", 2, "the { of this line is never closed"),
    "bracket": ("scan:\n  roi: [1, 2\nsample: 3\n", 2, "the [ of this line is never closed"),
    "bracket at the end": ("scan:\n  roi: [1, 2\n", 2, "the [ of this line is never closed"),
    "bracket in a brace": ("scan: {roi: [1, 2}\n", 1, "the [ of this line is never closed"),
    "quote": ('sample:\n  name: "x\n  title: y\n', 2, 'the " of this line is never closed'),
    "apostrophe": ("sample:\n  name: 'it's'\n", 2, "text follows after the closing quote"),
    "space": ("scan:\n  mode:step\n  views: 3\n", 3, "a space is missing after the colon of the line above"),
    "space of the first": ("mode:step\nviews: 3\n", 2, "a space is missing after the colon of the line above"),
    "colon": ("scan:\n  mode step\n  views: 3\n", 3, "a colon is missing after a key"),
    "two colons": ("sample:\n  name: a: b\n", 2, "a colon is missing, or a value that contains a colon needs quotes"),
    "deeper": ("scan:\n  mode: step\n    views: 3\n", 3, "this line is indented deeper than the one above"),
    "between": (
        "scan:\n    mode: step\n  views: 3\n",
        3,
        "the indentation of this line does not match the indentation of any group above",
    ),
    "at": ("sample:\n  name: @x\n", 2, "a value begins with '@'; put it in quotes"),
    "star": ("sample:\n  name: *x\n", 2, "text that begins with * or & needs quotes"),
    "control character": ("a: 1\nb: x\0y\n", 2, "the character U+0000 is not allowed in text"),
    "tag": ("a: 1\nb: !foo 3\n", 2, "text that begins with ! or = needs quotes"),
    "equals": ("a: 1\nb: =\n", 2, "text that begins with ! or = needs quotes"),
    "two documents": ("a: 1\n---\nb: 2\n", 2, "a second YAML document begins here"),
    "list as a key": ("? [1, 2]\n: 3\n", 1, "a key of this line is a list or a group"),
    "backslash": ('a: 1\nb: "C:\\data"\n', 2, "in double quotes, a backslash starts a special character"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_said_in_words_with_its_line(name: str) -> None:
    text, line, said = FAULTS[name]
    with pytest.raises(ConfigError) as raised:
        read(text, "my.yaml")
    assert str(raised.value).startswith(f"my.yaml:{line}: this is not YAML ({said}"), raised.value
