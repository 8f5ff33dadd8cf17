"""Search of the best control within a time, on levels of the sample rate and inside limits."""
