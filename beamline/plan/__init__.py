"""Plan: angles, trigger trains, timeline and limits of a scan, before it starts."""
