"""mjfim: optimal experiment design and system identification with MuJoCo.

`propose` makes a first experiment of a model, `check` says which parameters can be identified,
`design` finds the excitation that gives the most information about them, `simulate` makes a
synthetic recording, `identify` estimates the parameters from recordings, and `monte_carlo` compares
the estimates with the Cramér-Rao bound.
"""

from importlib import import_module

# The module `typing` is not imported, because a file of this name in the current folder would be
# taken until `mjfim.__main__` has removed that folder from the search path.
TYPE_CHECKING = False

# Programs import each name when they use it first, see `__getattr__`: importing all of them takes
# seconds, in which the command line must be able to react to Ctrl-C.
if TYPE_CHECKING:
    from mjfim.errors import MjfimError
    from mjfim.excitation.design import design, design_jointly
    from mjfim.excitation.evaluation import evaluate, simulate
    from mjfim.excitation.rehearsal import rehearse
    from mjfim.excitation.shortest_horizon import ShortestExperiment, shortest_experiment
    from mjfim.experiment.schema import Experiment
    from mjfim.identification.assessment.parameter_draws import draw_parameters
    from mjfim.identification.identify import identify
    from mjfim.identification.inverse_dynamics import inverse_dynamics
    from mjfim.identification.left_out import predict
    from mjfim.identification.meter import Meter
    from mjfim.output.export.design import export_design
    from mjfim.output.export.sysid import export_sysid, sysid_control
    from mjfim.output.film import save_video
    from mjfim.output.rerun.live import live
    from mjfim.parallel import ExecutorLike, Pool, Workers
    from mjfim.parallel.budget import Budget, StopToken
    from mjfim.records.campaign import Campaign
    from mjfim.records.check import Check
    from mjfim.records.design import Design
    from mjfim.records.estimate import Estimate
    from mjfim.records.estimate_parts import InverseDynamicsFit
    from mjfim.records.rehearsal import Rehearsal
    from mjfim.records.robots import RobotComparison
    from mjfim.records.studies import Comparison, MonteCarloStudy
    from mjfim.records.trajectory import Recording, Trajectory
    from mjfim.records.watch import Watch
    from mjfim.records.worth import Worth
    from mjfim.studies.campaign import run_campaign
    from mjfim.studies.check import check
    from mjfim.studies.compare import compare
    from mjfim.studies.first_experiment import propose
    from mjfim.studies.monte_carlo import monte_carlo
    from mjfim.studies.payload import identify_payload
    from mjfim.studies.robot_comparison import compare_estimates
    from mjfim.studies.selected_models import selected_experiment
    from mjfim.studies.selection import select_terms
    from mjfim.studies.worth import worth

__all__ = [
    "Budget",
    "Campaign",
    "Check",
    "Comparison",
    "Design",
    "Estimate",
    "ExecutorLike",
    "Experiment",
    "InverseDynamicsFit",
    "Meter",
    "MjfimError",
    "MonteCarloStudy",
    "Pool",
    "Recording",
    "Rehearsal",
    "RobotComparison",
    "ShortestExperiment",
    "StopToken",
    "Trajectory",
    "Watch",
    "Workers",
    "Worth",
    "check",
    "compare",
    "compare_estimates",
    "design",
    "design_jointly",
    "draw_parameters",
    "evaluate",
    "export_design",
    "export_sysid",
    "identify",
    "identify_payload",
    "inverse_dynamics",
    "live",
    "monte_carlo",
    "predict",
    "propose",
    "rehearse",
    "run_campaign",
    "save_video",
    "select_terms",
    "selected_experiment",
    "shortest_experiment",
    "simulate",
    "sysid_control",
    "worth",
]
__version__ = "0.1.0"

# Module of each name.
MODULES = {
    "Budget": "mjfim.parallel.budget",
    "StopToken": "mjfim.parallel.budget",
    "MjfimError": "mjfim.errors",
    "design": "mjfim.excitation.design",
    "evaluate": "mjfim.excitation.evaluation",
    "design_jointly": "mjfim.excitation.design",
    "rehearse": "mjfim.excitation.rehearsal",
    "Rehearsal": "mjfim.records.rehearsal",
    "ShortestExperiment": "mjfim.excitation.shortest_horizon",
    "shortest_experiment": "mjfim.excitation.shortest_horizon",
    "Experiment": "mjfim.experiment.schema",
    "simulate": "mjfim.excitation.evaluation",
    "predict": "mjfim.identification.left_out",
    "identify": "mjfim.identification.identify",
    "Meter": "mjfim.identification.meter",
    "inverse_dynamics": "mjfim.identification.inverse_dynamics",
    "draw_parameters": "mjfim.identification.assessment.parameter_draws",
    "export_design": "mjfim.output.export.design",
    "export_sysid": "mjfim.output.export.sysid",
    "sysid_control": "mjfim.output.export.sysid",
    "live": "mjfim.output.rerun.live",
    "save_video": "mjfim.output.film",
    "ExecutorLike": "mjfim.parallel",
    "Pool": "mjfim.parallel",
    "Workers": "mjfim.parallel",
    "Campaign": "mjfim.records.campaign",
    "Check": "mjfim.records.check",
    "Comparison": "mjfim.records.studies",
    "Design": "mjfim.records.design",
    "Estimate": "mjfim.records.estimate",
    "InverseDynamicsFit": "mjfim.records.estimate_parts",
    "MonteCarloStudy": "mjfim.records.studies",
    "Recording": "mjfim.records.trajectory",
    "RobotComparison": "mjfim.records.robots",
    "Trajectory": "mjfim.records.trajectory",
    "Watch": "mjfim.records.watch",
    "Worth": "mjfim.records.worth",
    "run_campaign": "mjfim.studies.campaign",
    "check": "mjfim.studies.check",
    "compare": "mjfim.studies.compare",
    "monte_carlo": "mjfim.studies.monte_carlo",
    "identify_payload": "mjfim.studies.payload",
    "compare_estimates": "mjfim.studies.robot_comparison",
    "select_terms": "mjfim.studies.selection",
    "selected_experiment": "mjfim.studies.selected_models",
    "worth": "mjfim.studies.worth",
    "propose": "mjfim.studies.first_experiment",
}


def __getattr__(name: str) -> object:
    """Import a name when it is used first."""
    if name in MODULES:
        return getattr(import_module(MODULES[name]), name)

    raise AttributeError(f"module 'mjfim' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Public names of the package, also those that are not imported yet."""
    return sorted({*__all__, "__version__", "__doc__"})
