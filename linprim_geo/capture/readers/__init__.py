"""One module per data format that a capture may come in."""
