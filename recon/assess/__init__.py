"""How good a volume is: against a truth, against its data, and against the time it took."""
