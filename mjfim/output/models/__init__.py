"""Models with identified values: the user's MJCF and URDF, and the types of `mujoco.sysid`."""
