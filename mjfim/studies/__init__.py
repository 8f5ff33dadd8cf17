"""Workflows over designs and estimates: check, compare, Monte Carlo, campaigns."""
