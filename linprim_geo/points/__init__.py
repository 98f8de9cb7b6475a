"""Initial points of a training: those of the capture, new ones, and what photographs show at them."""
