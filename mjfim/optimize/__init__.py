"""Optimisers that know arrays only: neither MuJoCo nor Fisher information."""
