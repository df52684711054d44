"""Wrong types of arguments: every public function and class names the argument, the value and what is expected."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

import recon
from recon.base.declared_types import check_arguments, is_of_type, refusal, types_of
from recon.base.kernel import Kernel
from recon.base.method import Method
from recon.methods import METHODS, by_name

NO_VALUES = {"AxisEstimate", "Kernel", "Materials", "Progress", "Projections", "Reconstruction", "TimedVolumes"} | {
    "WithoutRings"
}
"""What functions return, and an enumeration: nobody makes these."""


def example(
    a: int | None, b: float, c: tuple[int, int], d: Sequence[str | Path], e: Mapping[str, int], f: Callable[[], int],
    g: ArrayLike | None, h: NDArray[np.float32], i: Literal["fbp", "sirt"], j: Kernel, k: str | Method, m: bool,
) -> None:  # fmt: skip
    check_arguments(example, locals())


LEGAL: tuple[Any, ...] = (3, 0.5, [1, 2], ("x",), {}, len, [[1.0]], np.zeros(2), "fbp", "gaussian", recon.Fbp(), True)
GIVEN = dict(zip(inspect.signature(example).parameters, LEGAL, strict=True))


OTHERS = (
    {"a": None}, {"a": np.int8(3)}, {"b": 3}, {"c": np.array([1, 2])}, {"d": [Path()]}, {"g": None}, {"g": 3},
    {"j": Kernel.COMPACT}, {"k": "sirt"}, {"m": np.True_}, {"a": np.array(3)}, {"b": np.array(0.5)},
)  # fmt: skip


@pytest.mark.parametrize("more", OTHERS)
def test_what_is_declared_is_taken(more: dict[str, Any]) -> None:
    example(**GIVEN | more)


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("a", "3", "a must be a whole number or None, got '3'"),
        ("a", True, "a must be a whole number or None, got True"),
        ("b", float("nan"), "b must be a number, got nan"),
        ("c", (1, 2, 3), "c must be 2 whole numbers, got (1, 2, 3)"),
        ("c", 3, "c must be 2 whole numbers, got 3"),
        ("d", "text", "d must be a list or tuple of texts or Paths, got 'text'"),
        ("e", [], "e must be a mapping, got []"),
        ("f", 3, "f must be a function, got 3"),
        ("g", "x", "g must be an array of numbers or None, got 'x'"),
        ("h", [1.0], "h must be an array, got [1.0]"),
        ("i", "fpb", "i 'fpb' is unknown; legal: fbp, sirt (did you mean fbp?)"),
        ("j", 3, "j 3 is unknown; legal: gaussian, compact:1.5"),
        ("k", recon.Fbp, "k must be text or a Method, got the class Fbp; give an object, such as Fbp()"),
        ("m", np.zeros(2), "m must be True or False, got ndarray of shape (2,)"),
    ],
)
def test_others_are_refused(name: str, value: Any, sentence: str) -> None:
    with pytest.raises(ValueError) as refused:
        example(**GIVEN | {name: value})
    assert str(refused.value) == sentence


class Unread:
    """A data set in a file, as h5py, zarr and dask have it."""

    dtype = np.dtype(np.uint16)

    def __array__(self) -> np.ndarray[Any, Any]:
        raise AssertionError("read for its type")


def test_a_data_set_is_not_read_for_its_type() -> None:
    example(**GIVEN | {"g": Unread(), "h": Unread()})


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
