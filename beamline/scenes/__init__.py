"""Scenes: their files, the truth behind them, and what can be asked of them. Features share it."""
