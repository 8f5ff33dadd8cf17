"""Recordings and parameters for `mujoco.sysid`, and both estimators on the same data."""
