"""Simulated scans of a scene without an instrument: frames, labels, the truth behind them, and the steps of a frame."""

COMMANDS = {
    "simulate": ("Simulate a scan of a scene, with labels and truth.", True),
}
