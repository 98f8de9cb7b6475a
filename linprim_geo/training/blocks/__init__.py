"""Large scenes, trained in blocks of space."""
