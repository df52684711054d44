"""Rules that readers of scan files rely on, and what a file breaks of them."""
