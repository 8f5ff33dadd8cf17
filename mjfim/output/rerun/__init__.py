"""Results as Rerun recordings, and the viewer. This package is the only importer of rerun."""

from __future__ import annotations

from mjfim.output.rerun.documents import log_design, log_estimate, log_trajectories, show

__all__ = ["log_design", "log_estimate", "log_trajectories", "show"]
