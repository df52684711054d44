"""The public names and their required parameters are those in docs/public_names.md."""

import pytest

from tests.public_names import FOR_BLUESKY, FOR_PACKAGES, FOR_SCRIPTS, lines, recorded, required


@pytest.mark.parametrize("module", [*FOR_SCRIPTS, *FOR_BLUESKY, *FOR_PACKAGES])
def test_public_names_are_those_of_the_page(module: str) -> None:
    if module in FOR_BLUESKY:
        pytest.importorskip("ophyd_async")
        pytest.importorskip("bluesky")
    on_page, there = recorded(module), set(lines(module))
    assert on_page
    assert not on_page - there, "gone, or needs other parameters: what uses it breaks (docs/releases.md)"
    new = {line for line in there - on_page if "." not in line.partition("(")[0]}  # members may come without their line
    assert not new, "`python -m tests.public_names` adds them to the page"


def test_what_must_be_given_is_told_apart_from_what_may() -> None:
    def function(first: int, second: int = 2, *rest: int, by_name: int, may: int = 3, **more: int) -> None: ...

    assert required(function) == "(first, *, by_name)"
    assert required(3) == ""
