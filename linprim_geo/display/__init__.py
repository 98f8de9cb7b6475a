"""The report page and the viewer."""
