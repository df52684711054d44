"""Each installed package has a row in docs/licences.md, and no package that users need is under the GPL."""

import pytest

from tests.licences import ELSEWHERE, FOR_USERS, brought, gpl, key, licence, row_of, rows, wanted


@pytest.fixture(scope="module")
def table() -> dict[str, str]:
    return rows()


@pytest.mark.parametrize("extra", [None, *FOR_USERS])
def test_all_that_users_install_has_a_row_and_is_not_under_the_gpl(extra: str | None, table: dict[str, str]) -> None:
    """With what packages bring in turn, as far as it is installed here."""
    packages = brought(wanted(extra))
    assert extra is not None or {"numpy", "h5py"} <= packages.keys()
    assert not [name for name in packages if row_of(name, table) is None], "python -m tests.licences adds the rows"
    assert not {name: words for name, package in packages.items() if gpl(words := licence(package))}


@pytest.mark.parametrize("extra", [None, *FOR_USERS])
def test_each_package_that_the_project_names_has_a_row_with_a_licence(extra: str | None, table: dict[str, str]) -> None:
    """Also where it is not installed here."""
    missing = [name for name in map(key, (each.name for each in wanted(extra))) if name not in table]
    assert not missing, "install the extra; python -m tests.licences adds the rows"


def test_every_row_states_a_licence(table: dict[str, str]) -> None:
    assert {"numpy", *ELSEWHERE} <= table.keys()
    assert not [name for name, words in table.items() if words in ("", "UNKNOWN")]


@pytest.mark.parametrize(
    ("words", "is_gpl"),
    [
        ("GPL-3.0-or-later", True),
        ("AGPL-3.0-only", True),
        ("GNU General Public License v2 (GPLv2)", True),
        ("LGPL-2.1-only", False),
        ("GNU Lesser General Public License v3 (LGPLv3)", False),
        ("GPL-3.0-or-later WITH GCC-exception-3.1", False),
        ("MIT OR GPL-2.0-only", False),
        ("BSD-3-Clause", False),
    ],
)
def test_what_counts_as_the_gpl(words: str, is_gpl: bool) -> None:
    assert gpl(words) is is_gpl
