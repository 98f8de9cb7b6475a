"""Photographs from files, image metrics, colours, plots."""
