"""Simulated scans of a scene without an instrument: frames, labels, the truth behind them, and what they cost."""

COMMANDS = {
    "simulate": ("Simulate a scan of a scene, with labels and truth.", True),
}
