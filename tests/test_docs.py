"""The pages of the docs site are in the navigation, and their links work."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
ENTRANCES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]


def test_every_page_is_in_the_navigation() -> None:
    listed = re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), flags=re.M)
    names = [path.relative_to(DOCS).as_posix() for path in PAGES]
    assert sorted(listed) == names


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as mkdocs makes them."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), flags=re.M)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower()) for title in titles}


@pytest.mark.parametrize("page", [*PAGES, *ENTRANCES], ids=lambda path: path.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"(?s)```.*?```", "", page.read_text(encoding="utf-8"))
    for target in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text):
        name, _, anchor = target.partition("#")
        leads_to = page.parent / name if name else page
        assert leads_to.exists(), target
        assert not anchor or anchor in anchors(leads_to), target


@pytest.mark.parametrize("page", ["python.md", "tutorials.md"])
def test_a_page_shows_examples_as_they_stand_in_their_files(page: str) -> None:
    """A plain viewer shows no included file, so that the page holds the text."""
    text = (DOCS / page).read_text(encoding="utf-8")
    assert "--8<--" not in text
    shown = re.findall(r"(?s)<!-- (docs/examples/\S+) -->\n```\w+\n(.*?)\n```\n", text)
    assert len(shown) == len(re.findall("<!-- docs/examples/", text)) >= 3
    for name, content in shown:
        assert content == (ROOT / name).read_text(encoding="utf-8").rstrip(), name
