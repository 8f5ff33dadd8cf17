"""Parameters of a campaign as its table and its figure show them."""

from __future__ import annotations

from dataclasses import dataclass

from mjfim.arrays import Array
from mjfim.model.parameters import ParameterSet
from mjfim.records.campaign import Campaign


@dataclass(frozen=True, eq=False, kw_only=True)
class CampaignParameters:
    """Parameters of a campaign.

    Attributes:
        names: Names of the p parameters.
        units: Their units; empty where a parameter has none.
        guess: (p,) guess before the first round [theta-unit].
        interest: Indices of the parameters that are not nuisance parameters.
        true: (p,) true values [theta-unit]; None where they are not known.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    guess: Array
    interest: tuple[int, ...]
    true: Array | None = None

    @classmethod
    def stated(cls, parameters: ParameterSet, *, simulated: bool) -> CampaignParameters:
        """Take the parameters of the experiment.

        Args:
            parameters: The parameters.
            simulated: True if the recordings were simulated at the true values.
        """
        return cls(
            names=parameters.names,
            units=tuple(parameter.unit for parameter in parameters.parameters),
            guess=parameters.guess,
            interest=tuple(parameters.interest.tolist()),
            true=parameters.true if simulated else None,
        )

    @classmethod
    def recorded(cls, campaign: Campaign) -> CampaignParameters:
        """Take the parameters from the record of a campaign, which does not know true values.

        Args:
            campaign: The campaign, with at least one round.
        """
        first = campaign.rounds[0]
        nuisance = {name for design in campaign.designs for name in design.nuisance}
        return cls(
            names=campaign.parameters,
            units=first.estimate.units,
            guess=first.theta,
            interest=tuple(j for j, name in enumerate(campaign.parameters) if name not in nuisance),
        )
