"""Storage: reads, writes and checks the files of scans, volumes and checkpoints."""
