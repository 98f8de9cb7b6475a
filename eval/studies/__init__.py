"""Studies that make the tables of the documents."""
