"""Wrong values of settings and arguments: the message names the setting, its value and what is expected."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from pkgutil import iter_modules
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

import recon
from recon.base.declared_types import (
    Checked,
    is_of_type,
    refusal,
    types_of,
)
from recon.base.kernel import Kernel
from recon.base.method import Method
from recon.base.setting import Count, Natural, NonNegative, Positive, Setting
from recon.base.volume import Grid
from recon.methods import METHODS, by_name

NO_VALUES = {"AxisEstimate", "Kernel", "Materials", "Progress", "Projections", "Reconstruction", "TimedVolumes"} | {
    "WithoutRings"
}
"""What functions return, and an enumeration: nobody makes these."""


@dataclass(frozen=True)
class Some(Checked):
    steps: Natural | None = None
    level: Annotated[int, Setting(ge=1, le=16)] = 3
    weight: NonNegative = 0.0
    rate: Positive | None = None
    start: Literal["fbp", "tv"] = "fbp"
    shape: Kernel = Kernel.COMPACT
    size: tuple[int, int] | None = None
    names: Sequence[str | Path] = ()
    part: Grid | Count = 1
    table: Mapping[str, int] | None = None
    call: Callable[[], int] | None = None
    values: ArrayLike | None = None
    array: NDArray[np.float32] | None = None
    method: str | Method = "fbp"
    flag: bool = False


@pytest.mark.parametrize(
    "values",
    [
        {}, {"steps": np.int64(4)}, {"level": 16}, {"weight": 0}, {"rate": 1e-300}, {"start": "tv"}, {"size": [1, 2]},
        {"shape": "gaussian"}, {"size": np.array([1, 2])}, {"names": [Path()]}, {"part": Grid((1, 1, 1))},
        {"table": {}}, {"call": len}, {"values": [[1.0]]}, {"values": 3}, {"array": np.zeros(2)},
        {"method": recon.Fbp()}, {"flag": np.True_},
    ],
)  # fmt: skip
def test_what_is_declared_is_taken(values: dict[str, Any]) -> None:
    Some(**values)


def test_a_number_in_an_array_without_axes_is_the_number() -> None:
    some = Some(**{"steps": np.array(4), "weight": np.array(0.5)})  # type: ignore[arg-type]
    assert (type(some.steps), type(some.weight)) == (int, float)
    assert some == Some(4, weight=0.5)


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("steps", -1, "must be a whole number >= 0 or None, got -1"),
        ("steps", 1.5, "must be a whole number >= 0 or None, got 1.5"),
        ("steps", True, "must be a whole number >= 0 or None, got True"),
        ("level", 17, "must be a whole number >= 1 and <= 16, got 17"),
        ("weight", math.nan, "must be a number >= 0, got nan"),
        ("weight", "0", "must be a number >= 0, got '0'"),
        ("rate", 0.0, "must be a number > 0 or None, got 0.0"),
        ("rate", math.inf, "must be a number > 0 or None, got inf"),
        ("start", "tvs", "'tvs' is unknown; legal: fbp, tv (did you mean tv?)"),
        ("shape", 3, "3 is unknown; legal: gaussian, compact:1.5"),
        ("size", (1, 2, 3), "must be 2 values, each a whole number or None, got (1, 2, 3)"),
        ("size", 3, "must be 2 values, each a whole number or None, got 3"),
        ("names", "ab", "must be a list or tuple, each value text or a Path, got 'ab'"),
        (
            "part",
            Grid,
            "must be a Grid or a whole number >= 1, got the class Grid; give an object, such as Grid()",
        ),
        ("part", "x" * 200, f"must be a Grid or a whole number >= 1, got '{'x' * 76}..."),
        ("table", [], "must be a mapping or None, got []"),
        ("call", 3, "must be a function or None, got 3"),
        ("values", "x", "must be an array of numbers or None, got 'x'"),
        ("array", [1.0], "must be an array or None, got [1.0]"),
        ("method", recon.Fbp, "must be text or a Method, got the class Fbp; give an object, such as Fbp()"),
        ("flag", np.zeros(2), "must be True or False, got ndarray of shape (2,)"),
    ],
)
def test_others_are_refused_with_what_was_expected(name: str, value: Any, sentence: str) -> None:
    with pytest.raises(ValueError) as refused:
        Some(**{name: value})
    assert str(refused.value) == f"{name} {sentence}"


class Unread:
    """A data set in a file, as h5py, zarr and dask have it."""

    dtype = np.dtype(np.uint16)

    def __array__(self) -> np.ndarray[Any, Any]:
        raise AssertionError("read for its type")


def test_a_data_set_is_not_read_for_its_type() -> None:
    Some(values=Unread(), array=Unread())  # type: ignore[arg-type]


def public() -> list[Any]:
    classes = [getattr(recon, name) for name in recon.__all__ if name not in NO_VALUES]
    return [*classes, *(by_name(name) for name in METHODS), recon.Geometry.parallel, recon.Geometry.cone]


@pytest.mark.parametrize("call", public(), ids=lambda call: call.__qualname__)
def test_a_public_function_names_the_argument(call: Any) -> None:
    if call is recon.Geometry:  # made by `parallel` and its like
        return
    taken = inspect.signature(call).parameters
    with pytest.raises((ValueError, TypeError)) as refused:
        call(**{name: object() for name, each in taken.items() if each.kind is not inspect.Parameter.VAR_KEYWORD})
    assert any(str(refused.value).startswith(name) for name in taken), refused.value


def test_every_declared_setting_of_a_method_refuses_a_foreign_object() -> None:
    for name in METHODS:
        for setting, kind in types_of(by_name(name)).items():
            if setting in inspect.signature(by_name(name)).parameters:
                assert not is_of_type(object(), kind), refusal(setting, object(), kind)


def test_no_module_hides_a_public_function() -> None:
    """A module sets its name in the package when it is imported."""
    assert not {module.name for module in iter_modules(recon.__path__)} & set(recon.__all__)
