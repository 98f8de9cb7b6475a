"""Adjust given poses, and refine poses and lenses of structure from motion, by what photographs show of surfaces."""
