"""The commands of `linprim-geo`, one file for each or for a few related ones.

A file has `add(command)`, which declares the arguments of its commands, and the functions that run them. Large
libraries are imported when a command runs, so that `--help` is fast.
"""
