"""Additions of other packages to a registry, and additions that are left out with a warning."""

from __future__ import annotations

import math
import re
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from recon.base import registry as module
from recon.base.registry import Registry, UnknownNameError, plugins


@pytest.fixture
def announced(monkeypatch: pytest.MonkeyPatch) -> list[EntryPoint]:
    """The entry points of all packages, in place of those installed."""
    points: list[EntryPoint] = []
    monkeypatch.setattr(module, "entry_points_announced", lambda: tuple(points))
    return points


def _point(name: str, value: str, kind: str = "reader") -> EntryPoint:
    return EntryPoint(name, value, f"splatline.{kind}")


def test_the_plug_ins_of_a_kind_come_by_name(announced: list[EntryPoint]) -> None:
    announced += [_point("tau", "math:tau"), _point("pi", "math:pi"), _point("e", "math:e", "effect")]

    assert list(plugins("reader", ()).items()) == [("pi", math.pi), ("tau", math.tau)]
    assert plugins("reader", (), lambda name, found: (name, round(found))) == {"pi": ("pi", 3), "tau": ("tau", 6)}
    assert plugins("stage", ()) == {}


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ([("old", "math:e")], r"'old' \(math:e\) was left out: .*used by splatline"),
        ([("twice", "math:e"), ("twice", "math:tau")], r"used by another plug-in"),
        ([("gone", "no_such_module:thing")], r"The volume format 'gone' .*ModuleNotFoundError"),
        ([("wrong", "math:no_such_thing")], r"AttributeError"),
        ([("odd", "math:inf")], r"OverflowError.*Everything else works without this plug-in"),
    ],
)
def test_what_does_not_load_or_fit_or_has_a_name_that_is_taken_is_left_out_with_a_warning(
    announced: list[EntryPoint], points: list[tuple[str, str]], said: str
) -> None:
    announced += [_point(*point, "volume_format") for point in [*points, ("pi", "math:pi")]]
    with pytest.warns(UserWarning) as told:
        assert plugins("volume_format", ("old",), lambda name, found: int(found)) == {"pi": 3}
    assert len(told) == len(points)

    assert all(re.search(said, str(warning.message)) for warning in told)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            RuntimeError("a\x1b[2Jb\nbeamline: all is well"),
            r"RuntimeError: a\\x1b\[2Jb beamline: all is well\. Everything",
        ),
        (SystemExit(0), r"SystemExit: 0\."),
        (ValueError("x" * 10**6), r"^.{1,1200}$"),
    ],
    ids=["control", "exit", "long"],
)
def test_a_plug_in_neither_ends_a_command_nor_writes_to_its_output(
    announced: list[EntryPoint], capsys: pytest.CaptureFixture[str], error: BaseException, said: str
) -> None:
    def made(name: str, found: object) -> object:
        print("welcome")
        raise error

    announced.append(_point("loud", "math:e"))
    with pytest.warns(UserWarning) as told:
        assert plugins("reader", (), made) == {}
    (message,) = (str(warning.message) for warning in told)
    assert re.search(said, message) and message.isprintable()
    assert capsys.readouterr() == ("", "welcome\n")


def test_a_registry_is_ours_with_the_additions_and_asks_for_them_at_its_first_use(
    announced: list[EntryPoint],
) -> None:
    registry = Registry("volume_format", {"two": 2.0}, lambda name, found: found / 2, reserved=("auto",))
    announced += [_point(name, "math:tau", "volume_format") for name in ("pi", "auto")]
    with pytest.warns(UserWarning, match="'auto'.*used by splatline"):
        assert dict(registry) == {"two": 2.0, "pi": math.pi}
    assert registry.ours == {"two": 2.0} and len(registry) == 2 and "auto" not in registry


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("tow", "volume format 'tow' is unknown; legal: two, three (did you mean two?)"),
        ("ten", "volume format 'ten' is unknown; legal: two, three"),
    ],
)
def test_a_name_that_there_is_not_is_told_with_those_that_there_are(
    announced: list[EntryPoint], name: str, said: str
) -> None:
    registry = Registry("volume_format", {"two": 2, "three": 3})
    with pytest.raises(UnknownNameError) as unknown:
        registry[name]
    assert str(unknown.value) == said and isinstance(unknown.value, ValueError)
    assert registry.get(name) is None and name not in registry


def test_an_add_on_that_is_installed_and_broken_says_what_broke(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, announced: list[EntryPoint]
) -> None:
    (tmp_path / "half_an_add_on.py").write_text("raise ImportError('libcudart.so.12: no such file\\x1b[2J')")
    monkeypatch.syspath_prepend(tmp_path)
    announced.append(_point("naf", "half_an_add_on:ENTRY", "method"))
    with pytest.warns(UserWarning, match="left out"), pytest.raises(UnknownNameError) as refused:
        Registry("method", {})["naf"]
    said = str(refused.value)
    assert "is installed, but does not load" in said and r"libcudart.so.12: no such file\x1b[2J" in said
    assert "--force-reinstall splatline-neural" in said
