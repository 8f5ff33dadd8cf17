"""What the user states (schema), and the system that it resolves to."""
