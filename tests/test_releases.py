"""Version, changelog, citation and the releases page agree."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from beamline.storage.readers import tiff
from beamline.storage.writers import recon_file
from tests.licences import FOR_USERS

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "releases.md").read_text(encoding="utf-8")
# Of semver.org, without build metadata.
SEMANTIC = r"(0|[1-9]\d*)\.(0|[1-9]\d*)\.(0|[1-9]\d*)(-[0-9A-Za-z.-]+)?"


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    return dict(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"])


def test_the_version_is_semantic_and_the_newest_release_of_the_changelog(project: dict[str, Any]) -> None:
    assert re.fullmatch(SEMANTIC, project["version"])
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    releases = re.findall(rf"(?m)^## \[({SEMANTIC})\] - (\d{{4}}-\d\d-\d\d)$", text)
    assert releases[0][0] == project["version"]
    assert [date for *_, date in releases] == sorted((date for *_, date in releases), reverse=True)


def test_the_citation_is_of_this_version(project: dict[str, Any]) -> None:
    """cffconvert --validate checks it against the schema of cff-version."""
    stated = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= stated.keys()
    assert (stated["version"], stated["license"]) == (project["version"], project["license"])
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"## [{stated['version']}] - {stated['date-released']}" in changelog


def test_the_page_lists_the_extras_of_users(project: dict[str, Any]) -> None:
    of_developers = {"dev", "docs", "oracle", "league", "browser"}
    assert set(project["optional-dependencies"]) == {*FOR_USERS} | of_developers
    assert re.findall(r"(?m)^\| `(\w+)` \|", PAGE) == list(FOR_USERS)


@pytest.mark.parametrize("marker", [recon_file._FORMAT, tiff.VOLUME])
def test_the_page_names_each_format_of_ours(marker: str) -> None:
    assert f"`{marker}`" in PAGE
