from .check import Check
from .design import Design, Status
from .estimate import Estimate
from .rehearsal import FiniteSteps, Rehearsal
from .studies import Campaign, CampaignStatus, Comparison, MethodOutcome, MonteCarloStudy
from .trajectory import Recording, Trajectory

__all__ = [
    "Campaign",
    "CampaignStatus",
    "Check",
    "Comparison",
    "Design",
    "Estimate",
    "FiniteSteps",
    "MethodOutcome",
    "MonteCarloStudy",
    "Recording",
    "Rehearsal",
    "Status",
    "Trajectory",
]
