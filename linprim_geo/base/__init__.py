"""Shared basics of all packages: errors, files, options, progress, memory, time budgets."""
