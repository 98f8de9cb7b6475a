"""A folder of photographs, or a video, becomes a `Scene`."""
