"""Where a training starts: the capture's points, new ones, and what photographs say of them."""
