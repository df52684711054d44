"""Quality of a volume: against a truth, by half data sets (FSC), and against the time spent."""
