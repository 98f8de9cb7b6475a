"""Measures accuracy against time: sweeps over options, tables and figures."""
