"""One training step: loss terms, parameter activation, density control and the optimiser state."""
