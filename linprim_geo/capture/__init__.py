"""Captures: from a folder of photographs, or a video, to a `Scene`."""
