"""Commands of other packages are found by the name that the package announces."""

from importlib.metadata import EntryPoint

import click
import pytest

from beamline.cli.main import commands
from recon.base import registry

hi = click.Command("say-hi", help="Say hi.", callback=print)
several = click.Group("several", help="A group that has no callback.", commands=[hi])


def test_commands_of_other_packages_have_the_names_these_announce(monkeypatch: pytest.MonkeyPatch) -> None:
    points = [EntryPoint("hello", f"{__name__}:hi", "splatline.command")]
    points += [EntryPoint("group", f"{__name__}:several", "splatline.command")]
    monkeypatch.setattr(registry, "entry_points_announced", lambda: tuple(points))
    known = commands.__wrapped__()
    assert (known["hello"].help, known["group"].help) == ("Say hi.", "A group that has no callback.")
    assert known["hello"].load("hello") is hi and known["group"].load("group") is several
