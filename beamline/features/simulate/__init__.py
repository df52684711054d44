"""Simulated scans of a scene without an instrument: frames, labels, the truth behind them, and what they cost."""

from __future__ import annotations

from beamline.cli.commands import CommandEntry, Libraries

COMMANDS = {
    "simulate": CommandEntry(
        "beamline.features.simulate.command",
        "Simulate a scan of a scene, with labels and truth.",
        Libraries.FRAMES,
    ),
}
