"""Compressed copies of scan files, compared with them frame by frame."""
