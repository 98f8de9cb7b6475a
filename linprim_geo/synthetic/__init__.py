"""Scenes with exact geometry, and photographs of them."""
