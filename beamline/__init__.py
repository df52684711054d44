"""The instrument and what surrounds it: configuration, scans, files, monitoring, reconstruction, reports, commands."""
