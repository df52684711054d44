"""The page on real scans contains the commands that made its pictures, and these pictures."""

from tests.bench.real_scans import FURTHER, ROOT, SCANS


def test_the_page_has_the_commands_and_the_pictures() -> None:
    page = (ROOT / "docs" / "real_scans.md").read_text(encoding="utf-8")
    commands = [command for shown in SCANS.values() for command in (shown.before, shown.after)]
    assert all(f"\n{command}\n" in page for command in (*commands, *FURTHER))
    for name in SCANS:
        assert f"(real_scans_{name}.jpg)" in page and (ROOT / "docs" / f"real_scans_{name}.jpg").is_file()
