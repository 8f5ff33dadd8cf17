"""Parameter estimation from recordings by multiple shooting, and its diagnostics."""
