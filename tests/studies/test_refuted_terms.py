"""Terms that left-out data refute are not tried again."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest

from mjfim.identification.assessment.term_tests import TermTests
from mjfim.records.terms import Decision, Selection, SelectionStep, TermNumber
from tests.support import results

BEGUN = SelectionStep(decision=Decision.BEGUN, error=2.0)


def tried(
    path: str, decision: Decision, reduction: float, joints: tuple[str, ...] = ()
) -> SelectionStep:
    """A step that tried a term."""
    return SelectionStep(
        decision=decision,
        description="damping at 3 joints" if joints else path,
        path=path,
        error=1.0,
        reduction=reduction,
        joints=joints,
    )


def test_terms_that_left_out_data_refute_are_those_of_the_last_attempt() -> None:
    """A step that removes a term at several joints has the path of its first joint."""
    steps = (
        BEGUN,
        tried("worse", Decision.REJECTED, -0.1),
        tried("unclear", Decision.REJECTED, 0.1),
        tried("better later", Decision.REJECTED, -0.1),
        tried("worse later", Decision.REJECTED, 0.1),
        tried("better later", Decision.ADDED, 0.2),
        tried("worse later", Decision.REJECTED, -0.2),
        tried("worse", Decision.ADDED, 0.2, ("pan", "lift", "roll")),
        tried("worse", Decision.REMOVED, 0.0),
    )
    selection = Selection(terms=(), steps=steps, ending="No further term.")
    assert selection.refuted == {"worse", "worse later"}


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("is_joint_refuted", [True, False])
def test_a_term_at_several_joints_is_refuted_apart_from_that_of_its_first_joint(
    order: int, is_joint_refuted: bool
) -> None:
    """Both have the same path."""
    joints = ("pan", "lift", "roll")
    reduction = 0.1 if is_joint_refuted else -0.1
    steps = (
        tried("joint/pan:damping", Decision.REJECTED, reduction),
        tried("joint/pan:damping", Decision.REJECTED, -reduction, joints),
    )
    selection = Selection(terms=(), steps=(BEGUN, *steps[::order]), ending="No further term.")
    number = partial(TermNumber, value=0.1, unit="", scale=0.1)
    single = replace(results.missing_term(), numbers=(number(path="joint/pan:damping"),))
    of_joints = replace(single, description="damping at 3 joints", joints=joints)
    left = TermTests(terms=(of_joints, single)).without(selection.refuted)
    assert left.terms == ((single,) if is_joint_refuted else (of_joints,))

    # The same joints in another order are the same term.
    numbers = (number(path="joint/roll:damping"),)
    again = replace(of_joints, numbers=numbers, joints=joints[::-1])
    assert (again.key in selection.refuted) == is_joint_refuted
