"""Plans for a given time and memory."""
