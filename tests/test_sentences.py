"""Sentences are short and read at first sight: in docstrings, messages and comments of the packages, and in pages."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.sentences import LONGEST, ROOT, hard, split

PACKAGES = ("recon", "drivers", "simulators", "beamline")

PARTS = [
    part.relative_to(ROOT).as_posix()
    for package in PACKAGES
    for part in sorted((ROOT / package).iterdir())
    if part.suffix == ".py" or (part.is_dir() and part.name != "__pycache__")
]
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs")


@pytest.mark.parametrize("part", PARTS)
def test_no_sentence_of_a_package_has_to_be_read_twice(part: str) -> None:
    assert [str(sentence) for sentence in hard(ROOT / part)] == []


def test_no_sentence_of_a_page_has_to_be_read_twice() -> None:
    assert [str(sentence) for page in PAGES for sentence in hard(ROOT / page)] == []


@pytest.mark.parametrize(
    "text",
    [
        "word " * (LONGEST + 1),
        "Kinds of references of which files lack some.",
        "'x' is none of a, b.",
        "What lies between is none of the sample's.",
        "Tell what a view shows that nobody has seen.",
    ],
)
def test_what_is_found(tmp_path: Path, text: str) -> None:
    (tmp_path / "page.md").write_text(text, encoding="utf-8")
    (tmp_path / "docstring.py").write_text(f'"""{text}"""\n', encoding="utf-8")
    (tmp_path / "message.py").write_text(f'x = f"{text} {{y}}"\n', encoding="utf-8")
    (tmp_path / "comment.py").write_text(f"x = 1  # {text}\n", encoding="utf-8")
    assert {sentence.path.stem for sentence in hard(tmp_path)} == {"page", "docstring", "message", "comment"}


def test_sentences_end_at_stops_items_and_rows() -> None:
    text = "One, e.g. this. Two\ngoes on.\n\n- three\n- four\n\nname: five. Six `a. b` X. Ray.\n  a    b\n"
    assert split(text) == ["One, e.g this.", "Two goes on.", "three", "four", "five.", "Six code X Ray.", "a b"]
