"""Sentences that a check says about what it found, the most serious first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mjfim.errors import first_ones, shortened
from mjfim.records.check import Check, ParameterCheck, ParameterGroup, groups_in_words, join_names


def verdict_of_check(check: Check) -> Iterator[str]:
    """Yield what a check found, the most serious first."""
    yield from _about_design(check)
    if check.missing:
        yield f"interrupted, so this check is incomplete; it lacks {join_names(check.missing)}"
    yield from _about_derivatives(check)
    yield from _about_identifiability(check)

    identifiable = [row for row in check.rows if not row.nuisance and np.isfinite(row.std)]
    if not identifiable:
        yield f"no parameter can be identified individually from {check.source}"
        return
    yield from _about_accuracy(check, identifiable)
    if check.confounded:
        pairs = [
            f"{shortened(pair.first)} / {shortened(pair.second)} ({pair.correlation:+.3f})"
            for pair in check.confounded
        ]
        yield (
            f"confounded pairs (correlation of the estimates): {first_ones(pairs)}; "
            "fixing one parameter of a pair makes the other more accurate"
        )


def _about_design(check: Check) -> Iterator[str]:
    """Judgement of a design about the initial control, before it begins."""
    for reason in check.refused:
        yield f"`mjfim design` refuses this experiment: {reason}"
    if check.violations:
        broken = first_ones([str(violation) for violation in check.violations], "; ")
        yield (
            f"the initial control violates limits: {broken}; σ is that of a motion outside the "
            "limits. A design looks for a motion inside"
        )


def _about_derivatives(check: Check) -> Iterator[str]:
    """Reason why the numbers of the check cannot be trusted, where the self-test failed."""
    tested = check.self_test
    if tested.roughness is not None:
        yield f"{tested.roughness}"
    elif tested.finished and not tested.passed:
        yield (
            f"the derivatives do not agree (psi recursion {tested.recursion:.1e}, slope "
            f"{tested.slope:.1e}); {tested.likely_cause}. Shorten horizon or timestep, or "
            "smooth what switches, before you trust these numbers"
        )


def _unknown_groups(check: Check) -> list[ParameterGroup]:
    """Inseparable groups that priors do not resolve either."""
    known = {row.name for row in check.rows if np.isfinite(row.std)}
    return [group for group in check.not_separable if not set(group.members) <= known]


def _about_identifiability(check: Check) -> Iterator[str]:
    """Combinations that cannot be identified, and advice for the user."""
    unknown = _unknown_groups(check)
    resolved = [group for group in check.not_separable if group not in unknown]
    if unknown:
        yield (
            "not identifiable separately from this initial state, with any tested control: "
            f"{groups_in_words(unknown)}. Remove or fix one parameter of each group, give it "
            "a prior, or measure another output; a design uses the identifiable combinations"
        )
    if resolved:
        names = first_ones([group.short_names for group in resolved], "; ")
        yield f"separated by priors only, not by data: {names}"
    if check.not_excited:
        yield (
            f"not excited by {check.source}, but another control would show: "
            f"{groups_in_words(check.not_excited)}. Move those joints more"
        )


def _about_accuracy(check: Check, identifiable: Sequence[ParameterCheck]) -> Iterator[str]:
    """Comparison of the predicted standard deviations with the wanted ones."""
    missed = [row for row in identifiable if row.repetitions != 1]
    if missed:
        worst = max(identifiable, key=lambda row: row.std / row.wanted)
        needed = "no number of repetitions reaches"
        if worst.repetitions:
            needed = f"{worst.repetitions:,} repetitions ({worst.seconds:,.0f} s) reach"
        wanted = f"{worst.wanted:.3g} {worst.unit}".rstrip()
        yield (
            f"{len(missed)} of {len(identifiable)} parameters miss the wanted σ with "
            f"{check.source} alone; the worst is {worst.name}: {needed} {wanted}. A designed "
            "excitation (`mjfim design`) needs fewer"
        )
        return
    is_certain = check.self_test.passed and not check.missing
    if is_certain and not _unknown_groups(check) and not check.not_excited:
        yield (
            f"every identifiable parameter reaches its wanted σ with {check.source}: "
            "nothing more is needed"
        )
