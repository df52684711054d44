"""Composed samples: bodies with their materials, as a scene names them."""
