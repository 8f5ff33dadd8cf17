"""MuJoCo models: load, vary, read and write parameters by path."""
