"""Mapping: what a scene's mapping may hold is read into values of the declared types; anything else is refused."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any, Literal

import pytest

from simulators.frame.mapping import SceneError, build, choose, located, named
from tests.messages import refused


@dataclass(frozen=True)
class Inner:
    kv: float
    filters: Mapping[str, float] | None = None


@dataclass(frozen=True)
class Outer:
    real: float = 0.5
    whole: int = 3
    flag: bool = False
    text: str = "a"
    choice: Literal["a", "b"] = "a"
    maybe: float | None = 1.0
    pair: tuple[int, float] = (1, 2.0)
    table: tuple[tuple[float, float], ...] = ()
    shares: Mapping[int, float] = field(default_factory=lambda: MappingProxyType({}))
    inner: Inner | None = None

    def __post_init__(self) -> None:
        if self.real < 0:
            raise ValueError(f"real must be >= 0, got {self.real}")


@pytest.mark.parametrize(
    ("mapping", "expected"),
    [
        ({}, Outer()),
        ({"real": 2}, Outer(real=2.0)),
        ({"real": "1e5"}, Outer(real=1e5)),
        ({"whole": -7}, Outer(whole=-7)),
        ({"whole": "12"}, Outer(whole=12)),
        ({"flag": True}, Outer(flag=True)),
        ({"text": "1e5"}, Outer(text="1e5")),
        ({"choice": "b"}, Outer(choice="b")),
        ({"maybe": None, "inner": None}, Outer(maybe=None)),
        ({"maybe": "2.0e3"}, Outer(maybe=2e3)),
        ({"pair": [4, 5]}, Outer(pair=(4, 5.0))),
        ({"table": [[1, "2e1"], (3, 4)]}, Outer(table=((1.0, 20.0), (3.0, 4.0)))),
        ({"shares": {3: 0.1, "5": 1}}, Outer(shares={3: 0.1, 5: 1.0})),
        ({"inner": {"kv": 60}}, Outer(inner=Inner(60.0))),
        ({"inner": {"kv": "6e1", "filters": {"Al": 1}}}, Outer(inner=Inner(60.0, {"Al": 1.0}))),
    ],
)
def test_values_take_the_declared_types(mapping: dict[str, Any], expected: Outer) -> None:
    assert build(Outer, "outer", mapping) == build(Outer, "outer", MappingProxyType(mapping)) == expected


@pytest.mark.parametrize("value", [None, "many", "", "nan", math.nan, math.inf, "-inf", [1], {"a": 1}, 10**400])
def test_a_number_is_finite(value: Any) -> None:
    with refused(SceneError):
        build(Outer, "outer", {"real": value})


@pytest.mark.parametrize(
    ("mapping", "words"),
    [
        (3, f"outer is 3; expected a group of keys: {', '.join(field.name for field in fields(Outer))}"),
        (
            {"reel": 1},
            "outer.reel is not a known key (did you mean real?); legal keys in this section: real, whole, flag, ",
        ),
        ({"whole": 1.5}, "outer.whole is 1.5; expected a whole number"),
        ({"whole": "many"}, "outer.whole is 'many'; expected a whole number"),
        ({"text": 4680}, "outer.text is 4680; expected text"),
        ({"choice": "c"}, "outer.choice is 'c'; expected a | b"),
        ({"pair": [1]}, "outer.pair is [1]; expected a list of 2: a whole number and a number"),
        ({"pair": [1, 2, 3]}, "outer.pair is [1, 2, 3]; expected a list of 2: a whole number and a number"),
        ({"pair": 1}, "outer.pair is 1; expected a list of 2: a whole number and a number"),
        ({"pair": [1.5, 1]}, "outer.pair.0 is 1.5; expected a whole number"),
        ({"table": "ab"}, "outer.table is 'ab'; expected a list of 0 or more: a list of 2: a number"),
        ({"table": [[1, 2], [1]]}, "outer.table.1 is [1]; expected a list of 2: a number"),
        ({"table": [[1, 2], [1, "x"]]}, "outer.table.1.1 is 'x'; expected a number"),
        ({"shares": [1]}, "outer.shares is [1]; expected a group of keys: any"),
        ({"shares": {"third": 1}}, "outer.shares.third: key must be a whole number"),
        ({"shares": {3: "x"}}, "outer.shares.3 is 'x'; expected a number"),
        ({"inner": 60}, "outer.inner is 60; expected a group of keys: kv, filters"),
        ({"inner": {}}, "outer.inner.kv is missing; expected a number"),
        (
            {"inner": {"kv": 1, "volts": 1}},
            "outer.inner.volts is not a known key; legal keys in this section: kv, filters",
        ),
        ({"inner": {"kv": 1, "filters": {"Al": None}}}, "outer.inner.filters.Al is null; expected a number"),
        ({"inner": {"kv": 1, "filters": {1: 1}}}, "outer.inner.filters.1: key must be a valid string"),
        ({"real": -1}, "outer: real must be >= 0, got -1.0"),
    ],
)
def test_a_wrong_value_is_refused_by_its_path(mapping: Any, words: str) -> None:
    with pytest.raises(SceneError) as caught:
        build(Outer, "outer", mapping)
    assert words in str(caught.value)


def test_an_entry_names_its_kind_alone_or_with_its_keys() -> None:
    choices = {"inner": Inner, "outer": Outer}
    assert choose("x", choices, "outer") == choose("x", choices, {"kind": "outer"}) == Outer()
    assert choose("x", choices, {"kind": "inner", "kv": 1}) == Inner(1.0)
    assert named("x", ["inner"], {"kind": "inner", "kv": 1}) == ("inner", {"kv": 1})
    for entry in ("teapot", {"kind": "teapot"}, {}, 3, None):
        with refused(SceneError):
            choose("x", choices, entry)


def test_a_value_error_gets_the_path_and_a_scene_error_keeps_its_own() -> None:
    for error, words in ((ValueError("too long"), r"^x: too long$"), (SceneError("y: too long"), r"^y: too long$")):
        with pytest.raises(SceneError, match=words), located("x"):
            raise error
