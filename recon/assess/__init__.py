"""Quality of a volume: compared with a ground truth, and with the time spent."""
