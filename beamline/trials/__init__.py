"""Trials: many reconstructions of one scan, each in a process of its own, in one table: a trade-off or a study."""
