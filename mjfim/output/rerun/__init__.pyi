from .documents import log_design, log_estimate, log_trajectories, show

__all__ = ["log_design", "log_estimate", "log_trajectories", "show"]
