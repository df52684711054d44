"""Base types that other packages may import: protocols of devices, frames, clocks and errors."""
