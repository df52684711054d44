"""Cases of a test that takes long: the first cases are quick tests, the others are slow tests."""

from collections.abc import Iterable
from typing import Any

import pytest


def others_slow(cases: Iterable[Any], quick: int = 1) -> list[Any]:
    """The cases for `parametrize` (a tuple for several arguments); those after the first `quick` are marked slow."""
    return [
        case if n < quick else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow)
        for n, case in enumerate(cases)
    ]
