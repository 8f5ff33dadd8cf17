"""The command line: one file per verb. Only this package knows rich and typer."""
