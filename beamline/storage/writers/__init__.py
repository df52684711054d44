"""Writers: scan files, reconstruction files, checkpoints."""
