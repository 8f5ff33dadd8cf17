from .campaign import Campaign, CampaignStatus
from .check import Check
from .design import Design, Status
from .estimate import Estimate
from .studies import Comparison, MethodOutcome, MonteCarloStudy, RobotConditions, Robustness
from .trajectory import Recording, Trajectory

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
