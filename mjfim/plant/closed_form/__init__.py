"""Derivatives of samples in closed form, for arms and other rigid bodies on hinges and slides."""
