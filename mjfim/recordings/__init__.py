"""Logs of any format as recordings in SI units, with doubts about them."""
