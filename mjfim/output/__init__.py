"""Files and pictures of results: archives, figures, Rerun recordings, identified MJCF."""
