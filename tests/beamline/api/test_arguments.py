"""Arguments of the wrong type raise a ConfigError that names the argument, its value and what is expected."""

import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from beamline import api

FUNCTIONS = (api.connect, api.scan, api.plan, api.monitor, api.stream, api.volumes, api.reconstruct)


@pytest.mark.parametrize("call", FUNCTIONS, ids=lambda call: call.__name__)
def test_a_function_names_the_argument(call: Callable[..., Any]) -> None:
    taken = [name for name in inspect.signature(call).parameters if name != "of_scan"]
    with pytest.raises(api.ConfigError) as refused:
        made = call(**dict.fromkeys(taken, object()))
        next(made if isinstance(made, Iterator) else iter(()))
    assert str(refused.value).startswith(taken[0]), refused.value


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"method": 5}, "method must be text or a Method, got 5"),
        ({"method": None}, "method must be text or a Method, got None"),
        ({"rows": 3}, "rows must be a slice or 2 values, each a whole number or None, got 3"),
        ({"binning": "2"}, "binning must be a whole number or None, got '2'"),
        ({"views": 3}, "views must be text or None, got 3"),
        ({"selection": {"views": "all"}}, "selection must be a Selection or None, got {'views': 'all'}"),
    ],
)
def test_a_reconstruction_says_what_it_expects(values: dict[str, Any], sentence: str) -> None:
    with pytest.raises(api.ConfigError) as refused:
        api.reconstruct(Path("none.h5"), **values)
    assert str(refused.value) == f"{sentence}. Nothing was started."


@pytest.mark.parametrize("values", [{"rows": 3}, {"binning": "2"}, {"cone": (1.0,)}, {"steps": ("rings",)}])
def test_a_selection_does_not_take_other_types(values: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"^{next(iter(values))} must be"):
        api.Selection(**values)
