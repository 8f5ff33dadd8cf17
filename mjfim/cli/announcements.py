"""Sentences about the duration of long work, which verbs print before they begin it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mjfim.arrays import Array
from mjfim.cli.common import Duration, errors
from mjfim.duration import in_words
from mjfim.errors import ExperimentError
from mjfim.excitation.duration import iteration_seconds
from mjfim.experiment.system import System
from mjfim.identification.duration import pass_seconds
from mjfim.parallel import cores
from mjfim.records.trajectory import Recording, Trajectory
from mjfim.studies.check import MAX_TESTED_SAMPLES
from mjfim.studies.duration import check_seconds, trials_seconds

# Duration from which work is announced [s].
ANNOUNCED_SECONDS = 20.0

# Duration of one iteration from which a design is refused, unless it states as much time [s].
LONGEST_ITERATION = 3600.0

# Share of the longest iteration below which its time need not be known accurately.
NEGLIGIBLE_SHARE = 0.1

# Fewest and most passes over the data that fits usually need, with predictions and intervals. A fit
# of a right model from a good guess needs about 15, that of a real log up to 50.
FEWEST_PASSES = 10
MOST_PASSES = 50

# Passes over the data of a check, beside its tests along the longest recording.
CHECK_PASSES = 3

# Ends of sentences about work that Ctrl-C ends.
BEST_IS_KEPT = "Ctrl-C ends it at any time with the best result so far"
DONE_IS_KEPT = "Ctrl-C ends it at any time; what is finished is kept"
QUICKER = "a shorter horizon, a lower rate or a longer timestep makes it quicker"


def announce_design(
    system: System,
    *,
    is_default: bool,
    longest_iteration: float = LONGEST_ITERATION,
    work: str = "the design",
) -> Duration | None:
    """Say how long a design takes, if it is long.

    Args:
        system: The system, whose experiment states the design.
        is_default: True if the time of the design is the default, not what the user stated.
        longest_iteration: Time of one iteration from which the design is refused [s].
        work: The work that takes this time, in words.

    Returns:
        The time; None if it is short or not known.

    Raises:
        ExperimentError: A single iteration would take hours, and no such time is stated.
    """
    descent = system.experiment.descent
    most = max(descent.max_iterations, 1)
    iteration = iteration_seconds(system, negligible=ANNOUNCED_SECONDS / most)
    if iteration is None:
        return None

    # A single iteration that takes hours is a mistyped horizon or rate, as a rule.
    stated = 0.0 if is_default else (descent.seconds or 0.0)
    if iteration > max(longest_iteration, stated):
        raise ExperimentError(_refusal_of_iteration(system, iteration))

    starts = number_of_starts(system)
    longest = most * -(-starts // min(cores(), starts)) * iteration
    if longest < ANNOUNCED_SECONDS:
        return None

    # The time of the design ends it, but not before the first iteration.
    end = longest
    duration = f"at most about {in_words(longest)}"
    if descent.seconds is not None and descent.seconds < longest:
        end = max(descent.seconds, iteration)
        key = "default of descent.seconds" if is_default else "descent.seconds"
        duration = f"at most about {in_words(end)} ({key}: {descent.seconds:g} s)"
    _say(f"one iteration takes about {in_words(iteration)}, and {work} {duration}; {BEST_IS_KEPT}")
    return Duration(seconds=end, word="at most")


def refusal_of_design(system: System, longest_iteration: float = LONGEST_ITERATION) -> str | None:
    """Say why a design is refused because of its duration, as the design itself does.

    Args:
        system: The system, whose experiment states the design.
        longest_iteration: Time of one iteration from which the design is refused [s].

    Returns:
        The sentence; None where the design is not refused.
    """
    stated = system.experiment.descent.seconds or 0.0
    iteration = iteration_seconds(system, negligible=NEGLIGIBLE_SHARE * longest_iteration)
    if iteration is None or iteration <= max(longest_iteration, stated):
        return None
    return _refusal_of_iteration(system, iteration)


def _refusal_of_iteration(system: System, iteration: float) -> str:
    """Sentence about a single iteration that takes too long: its time [s]."""
    experiment = system.experiment
    return (
        f"{experiment.source}: horizon: {experiment.horizon:g} s at {experiment.rate:g} Hz: one "
        f"iteration would take about {in_words(iteration)}; {QUICKER} (descent.seconds = "
        f"{2.0 * iteration:.1g} permits it)"
    )


def number_of_starts(system: System) -> int:
    """Number of initial controls of a design."""
    descent = system.experiment.descent
    further = len(descent.previous) + len(descent.fourier) + len(descent.repeats)
    return descent.starts + further


def announce_check(system: System, control: Array) -> Duration | None:
    """Say how long a check of a control takes, if it is long.

    Args:
        system: The system.
        control: (N, nu) control [unit of the actuator].

    Returns:
        The time; None if it is short or not known.
    """
    seconds = check_seconds(system, control, negligible=ANNOUNCED_SECONDS)
    if seconds is None or seconds < ANNOUNCED_SECONDS:
        return None
    _say(f"the check takes about {in_words(seconds)}; {QUICKER}")
    return Duration(seconds=seconds)


def announce_fit(system: System, recordings: Sequence[Recording]) -> None:
    """Say how long a fit may take, if it is long.

    Nobody knows beforehand how many passes over the data it needs, so that both ends of the usual
    range are stated.

    Args:
        system: The system whose parameters are fitted.
        recordings: The recordings.
    """
    each = pass_seconds(system, recordings)
    if each is None or FEWEST_PASSES * each < 0.5 * ANNOUNCED_SECONDS:
        return

    shortest, longest = in_words(FEWEST_PASSES * each), in_words(MOST_PASSES * each)
    _say(
        f"{_rows_in_words(recordings)}: one pass over the data takes about {in_words(each)}, and "
        f"the fit, of {FEWEST_PASSES} to {MOST_PASSES} passes, {shortest} to {longest}; "
        f"{BEST_IS_KEPT}"
    )


def announce_check_of_recordings(
    system: System, recordings: Sequence[Recording]
) -> Duration | None:
    """Say how long a check of recordings takes, if it is long.

    Args:
        system: The system.
        recordings: The recordings.

    Returns:
        The time; None if it is short or not known.
    """
    each = pass_seconds(system, recordings)
    if each is None:
        return None

    # The derivatives are tested along the longest recording only.
    longest = max(recordings, key=lambda recording: len(recording.ctrl))
    control = longest.ctrl[: min(MAX_TESTED_SAMPLES, len(longest.t) - 1)]
    tests = check_seconds(system, control, negligible=ANNOUNCED_SECONDS) or 0.0

    total = CHECK_PASSES * each + tests
    if total < ANNOUNCED_SECONDS:
        return None
    _say(
        f"{_rows_in_words(recordings)}: one pass over the data takes about {in_words(each)}, and "
        f"the check about {in_words(total)}"
    )
    return Duration(seconds=total)


def _rows_in_words(recordings: Sequence[Recording]) -> str:
    """Number of rows of all recordings."""
    return f"{sum(len(recording.t) for recording in recordings):,} rows"


def announce_trials(
    system: System, trajectories: Mapping[str, Trajectory], trials: int
) -> Duration:
    """Say how long a Monte-Carlo study takes, if it is long.

    Args:
        system: The system.
        trajectories: Trajectories by name.
        trials: Number of repetitions of each.

    Returns:
        The time.
    """
    seconds = trials_seconds(system, trajectories, trials)
    if seconds >= ANNOUNCED_SECONDS:
        _say(f"{trials:,} trials take about {in_words(seconds)}; {DONE_IS_KEPT}")
    return Duration(seconds=seconds)


def announce_comparison(methods: int, seconds: float) -> None:
    """Say how long a comparison takes, if it is long.

    Args:
        methods: Number of compared methods.
        seconds: Time of each [s].
    """
    total = methods * seconds
    if total >= ANNOUNCED_SECONDS:
        _say(
            f"{methods} methods of at most {in_words(seconds)} each take at most about "
            f"{in_words(total)}; {DONE_IS_KEPT}"
        )


def _say(sentence: str) -> None:
    """Print a sentence on stderr."""
    errors.print(f"mjfim: {sentence}", markup=False)
