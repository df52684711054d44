"""Plan: angles, trigger trains, timeline and limits of a scan that has not begun."""
