"""Poses and lenses, adjusted and refined by what photographs show of surfaces."""
