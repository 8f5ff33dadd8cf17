"""The user's URDF with identified values."""
