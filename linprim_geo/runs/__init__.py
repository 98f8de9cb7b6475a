"""The folder of a training, and rendering from it."""
