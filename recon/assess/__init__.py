"""Quality of a volume: against a truth, and against the time spent."""
