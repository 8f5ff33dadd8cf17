"""Distances of a robot to itself and to the world."""
