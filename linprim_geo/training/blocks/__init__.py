"""Training of large scenes, split into blocks of space."""
