"""Frozen records that verbs take and return: arrays with names and units.

Each record can be saved and loaded.
"""

from mjfim.records.campaign import Campaign, CampaignStatus
from mjfim.records.check import Check
from mjfim.records.comparison import Comparison, MethodOutcome
from mjfim.records.design import Design, Status
from mjfim.records.estimate import Estimate
from mjfim.records.monte_carlo import MonteCarloStudy
from mjfim.records.recording import Recording
from mjfim.records.robustness import RobotConditions, Robustness
from mjfim.records.trajectory import Trajectory

__all__ = [
    "Campaign",
    "CampaignStatus",
    "Check",
    "Comparison",
    "Design",
    "Estimate",
    "MethodOutcome",
    "MonteCarloStudy",
    "Recording",
    "RobotConditions",
    "Robustness",
    "Status",
    "Trajectory",
]
