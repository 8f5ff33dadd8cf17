"""Limits: what is stated, constraints at samples, and their verification on the model."""
