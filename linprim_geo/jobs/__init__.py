"""Tasks on several processes of this machine or on Ray."""
