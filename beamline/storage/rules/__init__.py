"""Rules that readers of scan files rely on, and findings where a file violates them."""
