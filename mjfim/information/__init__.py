"""The Fisher information of a trajectory, its criteria, and what it cannot see."""
