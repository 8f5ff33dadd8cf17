"""What is written to disk or drawn: archives, figures, Rerun recordings, identified MJCF."""
