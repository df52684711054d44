"""The instrument and everything around it: configuration, scans, files, monitoring, reconstruction, reports, commands."""
