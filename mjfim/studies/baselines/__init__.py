"""Parametric excitations that the design is compared with."""
