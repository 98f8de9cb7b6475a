"""Planning a training for a given time and memory."""
