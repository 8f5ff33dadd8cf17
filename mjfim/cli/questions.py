"""Questions of `mjfim init --ask`, each with an answer that Enter takes.

Answers may also come from a file or from another program, one a line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import typer

from mjfim.errors import ExperimentError, listed
from mjfim.studies import GROUPS
from mjfim.studies.first_candidates import (
    Wishes,
    groups_of,
    require_carrier,
    require_keyframe,
    require_rate,
    resting_keyframes,
)
from mjfim.studies.first_experiment import Proposal, wanted_times

Answer = TypeVar("Answer")

# Answers that stand for what is proposed, and for no payload.
PROPOSED = "proposed"
NOTHING = "none"

# Units of the kinds of noise.
UNITS = {"angle": "rad", "length": "m", "angular velocity": "rad/s", "velocity": "m/s"}

# Message where the answers end too early.
TOO_SHORT = "--ask: the input ended before the last question; an empty line takes the default"


def ask(propose: Callable[[Wishes], Proposal], wishes: Wishes) -> Wishes:
    """Ask for the choices of a first experiment.

    Args:
        propose: Proposes an experiment that fulfils some wishes.
        wishes: What the options of the verb state.

    Returns:
        The wishes with the answers.

    Raises:
        ExperimentError: The input ends before the last question is answered.
    """
    typer.echo("Enter takes the answer in brackets.", err=True)
    proposal = propose(wishes)
    wishes = replace(wishes, keyframe=_keyframe(proposal))

    # Rate, horizon and noise follow from the start.
    if wishes.keyframe not in (None, proposal.start.keyframe):
        proposal = propose(wishes)
    wishes = _with_parameters(proposal, wishes)
    wishes = _with_times(proposal, wishes)
    return replace(wishes, sigmas=_sigmas(proposal))


def _keyframe(proposal: Proposal) -> str | None:
    """The keyframe in which the experiment starts; None for the proposed start."""
    names = resting_keyframes(proposal.compiled)
    if not names:
        return None

    question = f"Start: a keyframe ({listed(names)}), or {PROPOSED!r} for {proposal.start.reason}"
    return _asked(
        question,
        PROPOSED,
        lambda text: None if text == PROPOSED else require_keyframe(proposal.compiled, text),
    )


def _with_parameters(proposal: Proposal, wishes: Wishes) -> Wishes:
    """The wishes with groups of parameters, and with the body that carries a payload."""
    default = ",".join(wishes.groups)
    groups = _asked(f"Unknown parameters, of {', '.join(GROUPS)}", default, groups_of)

    def carrier_of(text: str) -> str | None:
        """A body that can carry a load; None for no load."""
        if text == NOTHING:
            return None
        require_carrier(proposal.compiled, text)
        return text

    question = f"Body that carries a load of unknown mass and place, or {NOTHING!r}"
    payload = _asked(question, wishes.payload or NOTHING, carrier_of)
    return replace(wishes, groups=groups, payload=payload)


def _with_times(proposal: Proposal, wishes: Wishes) -> Wishes:
    """The wishes with rate and horizon; None for those that are proposed."""
    model, times = proposal.compiled, proposal.times

    def rate_of(text: str) -> float:
        """A rate that fits to the timestep."""
        return require_rate(model, _positive(text))

    proposed = f"{times.rate:.9g}"
    rate = _asked("Rate of samples and controls [Hz]", proposed, rate_of)
    wishes = replace(wishes, rate=None if rate == float(proposed) else rate)

    def horizon_of(text: str) -> float:
        """A horizon that has samples at the rate."""
        horizon = _positive(text)
        wanted_times(times, model, replace(wishes, horizon=horizon))
        return horizon

    proposed = f"{times.horizon:.9g}"
    horizon = _asked("Duration of the experiment [s]", proposed, horizon_of)
    return replace(wishes, horizon=None if horizon == float(proposed) else horizon)


def _sigmas(proposal: Proposal) -> dict[str, float]:
    """Standard deviations of the measured joints by kind; those of the MJCF are not asked for."""
    proposed = {kind: sigma for _, sigma, kind in proposal.noise if kind}
    return {
        kind: _asked(f"Noise of each measured {kind} [{UNITS[kind]}]", f"{sigma:g}", _positive)
        for kind, sigma in proposed.items()
    }


def _asked(question: str, default: str, value_of: Callable[[str], Answer]) -> Answer:
    """Ask until an answer is valid.

    Args:
        question: The question.
        default: Answer that Enter takes.
        value_of: Value of an answer; raises ExperimentError for one that is not valid.

    Raises:
        ExperimentError: The input has ended.
    """

    def checked(text: str) -> Answer:
        """The value of an answer; BadParameter asks again."""
        try:
            return value_of(text.strip())
        except ExperimentError as error:
            raise typer.BadParameter(str(error).removeprefix("payload: ")) from None

    try:
        answer: Answer = typer.prompt(question, default=default, value_proc=checked, err=True)
    except typer.Abort:
        raise ExperimentError(TOO_SHORT) from None
    return answer


def _positive(text: str) -> float:
    """A positive number."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise ExperimentError(f"{text!r} is no positive number")
    return value
