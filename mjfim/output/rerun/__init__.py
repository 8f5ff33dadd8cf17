"""Results as Rerun recordings, and the viewer. Only the modules of this package import rerun."""

from __future__ import annotations

from mjfim.output.rerun.documents import log_design, log_estimate, log_trajectories
from mjfim.output.rerun.viewer import show

__all__ = ["log_design", "log_estimate", "log_trajectories", "show"]
