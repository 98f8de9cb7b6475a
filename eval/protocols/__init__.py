"""Mesh protocols of public benchmarks."""
