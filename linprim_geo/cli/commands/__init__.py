"""The commands of `linprim-geo`, a file for each or for a few that belong together.

A file has `add(command)`, which declares what its commands take, and the functions that run them. Large libraries are
imported where a command runs, so that `--help` stays instant.
"""
