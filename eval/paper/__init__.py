"""The tables of the LinPrim paper, made again here."""
