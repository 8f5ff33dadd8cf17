from .campaign import Campaign, CampaignStatus
from .check import Check
from .comparison import Comparison, MethodOutcome
from .design import Design, Status
from .estimate import Estimate
from .monte_carlo import MonteCarloStudy
from .robustness import RobotConditions, Robustness
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
