"""Reproduction of the tables of the LinPrim paper."""
