"""Logs of any format as recordings in SI units, with remarks about the quality of their data."""
