"""Photographs from files, sampling, image metrics, colours, plots."""
