"""Microstructure of a volume: fractions, sizes, surfaces, contacts and tortuosity, each with an interval."""
