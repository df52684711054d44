"""Writers of scan files, reconstruction files and checkpoints."""
