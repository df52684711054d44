"""Hamamatsu cameras over the DCAM-API."""
