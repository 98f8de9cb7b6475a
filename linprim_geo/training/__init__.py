"""Training: from a scene to optimised primitives."""
