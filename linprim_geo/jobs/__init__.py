"""Tasks that run in several processes of this machine or on Ray."""
