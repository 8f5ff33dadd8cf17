"""Results in words and tables, for the terminal, Rerun and figures; a module per record."""
