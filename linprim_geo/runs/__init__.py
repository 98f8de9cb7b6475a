"""Run folders: the results of a training, and rendering from them."""
