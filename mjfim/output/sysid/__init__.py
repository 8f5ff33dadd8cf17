"""Recordings and parameters for `mujoco.sysid`, and a comparison of its fits with mjfim's."""
