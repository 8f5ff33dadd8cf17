"""Tests of physical terms that a model may lack.

Most candidates (`mjfim/identification/candidates.py`) have score tests. Each of their numbers has a
column of sensitivities at the estimate. With the score g and the information I of the numbers of a
term, both after the parameters are eliminated, the term would reduce the sum of squared residuals
by `g' I^-1 g`, which is chi-squared distributed where the model is complete, and its estimated size
is `-I^-1 g`. The columns of the parameters are those of the stated model, which are simulated once;
those of the candidates are differences of an extended model that has many of them
(`mjfim/identification/score_rows.py`).

Terms that change the coordinates of the model, such as an elastic joint, have no such test. They
are screened by simulations with some of their values (`mjfim/identification/screened_terms.py`).
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.experiment.system import System
from mjfim.identification.candidates import (
    Candidate,
    CandidateParameter,
    candidates_of,
    impossible_terms_of,
    load_candidates_of,
)
from mjfim.identification.data_parts import part_of_data
from mjfim.identification.extended_problems import extended_problem, extended_system
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.payload_candidates import payload_candidates_of
from mjfim.identification.score_rows import ScoreRows
from mjfim.identification.screened_terms import screened_terms
from mjfim.optimize.condensed_least_squares import Condensed
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.records.terms import MissingTerm, TermParameter, TermTestData
from mjfim.records.trajectory import Recording

# Probability, over all candidates, that one is reported although the model is complete.
SIGNIFICANCE = 1e-3

# Smallest share of the sum of squared residuals that a reported term explains.
MIN_EXPLAINED_SHARE = 2e-3

# Largest number of numbers that one linearisation tests; more of them are tested in groups.
MAX_TESTED = 100

# Largest number of terms that an estimate names.
MAX_NAMED_TERMS = 4

# Terms whose significances differ by less than this share explain the residuals equally well. They
# keep the order of the candidates, which rounding errors cannot change.
EQUAL_SIGNIFICANCE = 1e-3

# Smallest share of a term's information that remains after the parameters are eliminated. With
# less, the term is not identifiable separately from the parameters.
MIN_REMAINING_SHARE = 1e-8

# Eigenvalues of the scaled information of the parameters below this share of the largest one count
# as zero.
INVERSE_TOLERANCE = 1e-12

# Smallest column norm in a denominator.
SMALLEST_NORM = 1e-300

# Largest number of samples that a linearisation by parameters and candidates simulates, over all of
# its differences. With more data, a part of every recording is enough for the tests.
MAX_SIMULATED = 400_000

# Fewest joints at which terms of one kind are tested together. With fewer, single terms are tried.
FEWEST_JOINTS = 3

# Samples of the motion from which the speeds of the joints are taken.
SPEED_SAMPLES = 2000


@dataclass(frozen=True, kw_only=True, eq=False)
class _Linearisation:
    """Normal equations of parameters and candidates, columns scaled to length 1.

    Attributes:
        H: (m, m) information.
        g: (m,) gradient of half of the squared residuals of the stated model.
        norms: (m,) lengths of the columns.
        columns: Columns of the numbers of every candidate.
        others: Columns of the parameters.
        inverse: Pseudo-inverse of the information about the parameters.
    """

    H: Array
    g: Array
    norms: Array
    columns: list[list[int]]
    others: np.ndarray
    inverse: Array


@dataclass(frozen=True, kw_only=True)
class _Member:
    """A significant term, which may be one of several of its kind.

    Attributes:
        candidate: The candidate.
        index: Its place in the linearisation.
        term: The term.
    """

    candidate: Candidate
    index: int
    term: MissingTerm


@dataclass(frozen=True, kw_only=True, eq=False)
class _ScoreTest:
    """Result of one score test.

    Attributes:
        values: (k,) estimated values of the numbers.
        explained: Reduction of the sum of squared residuals.
        sigmas: The equivalent deviation of a normal variable.
    """

    values: Array
    explained: float
    sigmas: float


@dataclass(frozen=True, kw_only=True)
class TermTests:
    """Result of the tests of all terms that a model may lack.

    A term at several joints and those of its single joints explain the same residuals. An estimate
    names only the more significant one (`named`). A selection of terms may try all of `terms`:
    where left-out data refute the term at all joints, that of one joint may still be missing.

    Attributes:
        terms: The significant terms, most significant first: the first `MAX_NAMED_TERMS` of all,
            and those that are named.
        data: The data on which they were tested; None where no test was possible.
    """

    terms: tuple[MissingTerm, ...] = ()
    data: TermTestData | None = None

    @property
    def named(self) -> tuple[MissingTerm, ...]:
        """The terms that an estimate names: at most `MAX_NAMED_TERMS`, most significant first.

        The terms of single joints of a more significant term at several joints are left out.
        """
        return _without_members(self.terms)[:MAX_NAMED_TERMS]

    def without(self, keys: Collection[str]) -> TermTests:
        """The tests without the terms that have some keys (`MissingTerm.key`)."""
        return replace(self, terms=tuple(term for term in self.terms if term.key not in keys))

    @property
    def remark(self) -> str:
        """Sentences about what was not tested, each with a space before it; empty for none."""
        if self.data is None:
            return ""
        about_data = "" if self.data.is_complete else f" {self.data}"
        sentences = (self.data.untested_sentence, self.data.impossible_sentence)
        return about_data + "".join(f" {sentence}" for sentence in sentences if sentence)


def find_missing_terms(
    problem: FitProblem, recordings: Sequence[Recording], at: UnknownValues
) -> TermTests:
    """Terms that would explain significant residuals.

    Args:
        problem: The least-squares problem, of which a part is tested where there are much data.
        recordings: All recordings.
        at: Solution of the problem.

    Returns:
        The terms, and the data on which they were tested.
    """
    system = problem.system
    groups = [
        *in_groups(list(candidates_of(system, _typical_speeds(problem, at)))),
        # The small masses of payloads would change the inertias at which the others are tested, so
        # that terms with equal effects would differ.
        *in_groups(list(payload_candidates_of(system))),
        # Contacts would slow down all simulations of the other candidates.
        *in_groups(list(load_candidates_of(system))),
    ]
    part = part_of_data(problem, _affordable_samples(problem, groups))
    tested, at = part.problem, part.unknowns(at)

    squares = 2.0 * tested.cost(at)
    found, untested = _by_score(tested, recordings, at, squares, groups)
    found += screened_terms(tested, recordings, at, squares)

    wanted = [term for term in found if term.share > MIN_EXPLAINED_SHARE]
    return TermTests(
        terms=first_terms(_by_significance(wanted)),
        data=TermTestData(
            share=part.share,
            recordings=part.recording_count,
            count=len(problem.recordings),
            untested=tuple(dict.fromkeys(untested)),
            impossible=tuple(impossible_terms_of(system)),
        ),
    )


def first_terms(ordered: Sequence[MissingTerm]) -> tuple[MissingTerm, ...]:
    """Select the terms that a selection tries or an estimate names from all significant ones.

    The terms of the single joints of one at several joints take no place of others.

    Args:
        ordered: The terms, most significant first.

    Returns:
        In the same order, the first `MAX_NAMED_TERMS` of all, and as many that are no terms of
        single joints of one before them.
    """
    first = (*ordered[:MAX_NAMED_TERMS], *_without_members(ordered)[:MAX_NAMED_TERMS])
    keys = {term.key for term in first}
    return tuple(term for term in ordered if term.key in keys)


def _without_members(ordered: Sequence[MissingTerm]) -> tuple[MissingTerm, ...]:
    """The terms in their order, without those that an earlier one at several joints contains."""
    kept: list[MissingTerm] = []
    for term in ordered:
        if not any(earlier.contains(term) for earlier in kept):
            kept.append(term)
    return tuple(kept)


def _affordable_samples(problem: FitProblem, groups: Sequence[Sequence[Candidate]]) -> float:
    """Number of samples on which groups of candidates are tested, at most."""
    tested = [sum(len(each.tested) for each in candidates) for candidates in groups]
    of_problem = problem.layout.column_count + problem.simulation.private_count
    return MAX_SIMULATED / (of_problem + max(tested, default=0))


def _by_score(
    problem: FitProblem,
    recordings: Sequence[Recording],
    at: UnknownValues,
    squares: float,
    groups: Sequence[Sequence[Candidate]],
) -> tuple[list[MissingTerm], list[str]]:
    """Terms whose score tests are significant, and descriptions of those that were not tested.

    Both are in the order of the candidates.
    """
    count = sum(len(candidates) for candidates in groups)

    # Of the variants of one term, the most significant one stands for it.
    found: dict[str, MissingTerm] = {}
    of_joints: list[MissingTerm] = []
    untested: list[str] = []
    stated = ScoreRows.of(problem, at) if count else None
    parts = (_linearised(stated, recordings, group) for group in groups)
    for candidates, linearisation in itertools.chain.from_iterable(parts):
        if linearisation is None:
            untested += [candidate.description for candidate in candidates]
            continue
        own: dict[str, _Member] = {}
        for index, candidate in enumerate(candidates):
            term = _score_test(candidate, index, linearisation, squares, count)
            key = candidate.variant_of or candidate.path
            if term is not None and (key not in found or term.sigmas > found[key].sigmas):
                found[key] = term
                own[key] = _Member(candidate=candidate, index=index, term=term)
        for members in _of_one_kind(list(own.values())):
            together = _joint_score_test(members, linearisation, squares, count)
            of_joints += [] if together is None else [together]
    return [*found.values(), *of_joints], untested


def _of_one_kind(members: Sequence[_Member]) -> list[list[_Member]]:
    """Significant terms of one kind at enough joints, the most significant one first."""
    kinds: dict[str, list[_Member]] = {}
    for member in members:
        kinds.setdefault(member.candidate.kind, []).append(member)
    return [
        sorted(of_kind, key=lambda member: -member.term.sigmas)
        for kind, of_kind in kinds.items()
        if kind and len({member.candidate.joint for member in of_kind}) >= FEWEST_JOINTS
    ]


def _linearised(
    stated: ScoreRows | None, recordings: Sequence[Recording], candidates: Sequence[Candidate]
) -> Iterator[tuple[Sequence[Candidate], _Linearisation | None]]:
    """Linearise by a group of candidates, and by parts of it where one of them prevents it.

    One candidate must not hide the others, so that a group that has no linearisation as a whole is
    divided into halves until the candidate is alone.

    Args:
        stated: The linearised stated problem; None where the simulation diverges next to its
            solution, so that no candidate has a linearisation.
        recordings: All recordings.
        candidates: The group.

    Yields:
        Candidates with their linearisation; None where the model cannot have them, or where the
        simulation diverges.
    """
    linearisation = None if stated is None else _linearise(stated, recordings, candidates)
    if linearisation is not None or stated is None or len(candidates) <= 1:
        yield candidates, linearisation
        return

    middle = len(candidates) // 2
    yield from _linearised(stated, recordings, candidates[:middle])
    yield from _linearised(stated, recordings, candidates[middle:])


def in_groups(candidates: Sequence[Candidate]) -> list[list[Candidate]]:
    """Divide candidates into groups that are linearised one after the other.

    The largest group decides on how much data all of them are tested, so that they are about
    equally large. A group with the terms of joints that follow each other may be larger than the
    others: that these can be tested together is worth more than the data that this costs.

    Args:
        candidates: The candidates.

    Returns:
        The groups, in the order of the candidates, with at most `MAX_TESTED` numbers each. The
        terms of the joints that follow each other are in one group where that is possible.
    """
    total = sum(len(candidate.tested) for candidate in candidates)
    group_count = max(-(-total // MAX_TESTED), 1)
    most = -(-total // group_count)

    # Terms of the joints stay together as far as possible, so that those of one kind can be tested
    # together.
    groups: list[list[Candidate]] = []
    size = most
    for _, neighbours in itertools.groupby(candidates, key=lambda candidate: bool(candidate.kind)):
        block = list(neighbours)
        of_block = sum(len(candidate.tested) for candidate in block)
        is_whole = block[0].kind != "" and of_block <= MAX_TESTED
        if is_whole and size + of_block > most:
            size = most
        for place, candidate in enumerate(block):
            size += len(candidate.tested)
            if size > most and (place == 0 or not is_whole):
                groups.append([])
                size = len(candidate.tested)
            groups[-1].append(candidate)
    return groups


def _typical_speeds(problem: FitProblem, at: UnknownValues) -> Array:
    """(nv,) root mean square of the speeds along the first recording [m/s or rad/s]."""
    first = problem.segments[0].recording
    motion = problem.simulation.motion(at, first, SPEED_SAMPLES)
    if motion is None:
        return np.zeros(problem.system.space.nv)
    return np.asarray(np.sqrt(np.mean(motion.qvel**2, axis=0)))


def _by_significance(terms: Sequence[MissingTerm]) -> list[MissingTerm]:
    """The terms, most significant first; equally significant ones in their given order."""
    left = list(terms)
    ordered = []
    while left:
        least = (1.0 - EQUAL_SIGNIFICANCE) * max(term.sigmas for term in left)
        ordered += [term for term in left if term.sigmas >= least]
        left = [term for term in left if term.sigmas < least]
    return ordered


def _linearise(
    stated: ScoreRows, recordings: Sequence[Recording], candidates: Sequence[Candidate]
) -> _Linearisation | None:
    """Linearise the residuals by parameters and candidates.

    None where the experiment with the candidates is invalid, or where a simulation diverges.
    """
    names = [
        [f"?{i}.{k}" for k in range(len(candidate.tested))]
        for i, candidate in enumerate(candidates)
    ]
    extended = _with_candidates(stated.problem.system, names, candidates)
    if extended is None:
        return None

    further = [name for of_candidate in names for name in of_candidate]
    wider, begin = extended_problem(
        stated.problem, recordings, stated.at, extended, differentiated_by=further
    )
    condensed = stated.condensed_with(wider, begin, further)
    if condensed is None:
        return None

    # The columns of the candidates follow those of the parameters.
    column = itertools.count(stated.problem.layout.column_count)
    columns = [[next(column) for _ in of_candidate] for of_candidate in names]
    return _normal_equations(condensed, columns)


def _with_candidates(
    system: System, names: Sequence[Sequence[str]], candidates: Sequence[Candidate]
) -> System | None:
    """The system with candidates as further parameters of given names; None where it is invalid."""
    parameters: dict[str, Any] = {}
    terms: dict[str, Any] = {}
    for i, (of_candidate, candidate) in enumerate(zip(names, candidates, strict=True)):
        if candidate.added is not None:
            terms[f"?{i}"] = candidate.added.table
        for name, number in zip(of_candidate, candidate.tested, strict=True):
            parameters[name] = {
                "target": _path_under(f"?{i}", candidate, number),
                "guess": number.linearised_at,
                "scale": number.size,
            }
    return extended_system(system, parameters, terms)


def _path_under(name: str, candidate: Candidate, number: CandidateParameter) -> str:
    """Path of a number of a candidate whose term has another name in the extended model."""
    if candidate.added is None:
        return number.path
    return number.path.replace(f"term/{candidate.added.name}:", f"term/{name}:", 1)


def _normal_equations(condensed: Condensed, columns: list[list[int]]) -> _Linearisation:
    """Information and gradient with scaled columns."""
    rows = np.concatenate([condensed.reduced_rows(), condensed.common_rows])
    norms = np.maximum(np.linalg.norm(rows[:, :-1], axis=0), SMALLEST_NORM)
    J = rows[:, :-1] / norms
    H = J.T @ J
    g = J.T @ rows[:, -1]

    # The parameters are eliminated by the pseudo-inverse of their information.
    tested = [column for of_candidate in columns for column in of_candidate]
    others = np.setdiff1d(np.arange(len(H)), tested)
    about_others = H[np.ix_(others, others)]
    inverse = np.linalg.pinv(about_others, rcond=INVERSE_TOLERANCE, hermitian=True)
    return _Linearisation(H=H, g=g, norms=norms, columns=columns, others=others, inverse=inverse)


def _score_test(
    candidate: Candidate, index: int, linearisation: _Linearisation, squares: float, count: int
) -> MissingTerm | None:
    """Score test of one candidate; None where it is not significant.

    Args:
        candidate: The term.
        index: Its place among the candidates.
        linearisation: Normal equations of parameters and candidates.
        squares: Sum of squared residuals.
        count: Number of candidates.
    """
    found = _tested(linearisation, linearisation.columns[index])
    if found is None or not _is_significant(found, squares, count):
        return None
    if _impossible(candidate.tested, found.values):
        return None

    main, *others_tested = candidate.tested
    tested_too = tuple(
        TermParameter(
            path=each.path,
            value=float(value),
            unit=each.unit,
            scale=_scale(value, each),
            is_size=True,
        )
        for each, value in zip(others_tested, found.values[1:], strict=True)
    )
    return MissingTerm(
        description=candidate.description,
        path=main.path,
        value=float(found.values[0]),
        unit=main.unit,
        sigmas=found.sigmas,
        share=found.explained / squares,
        further=(*tested_too, *candidate.further),
        added=candidate.added,
        source=candidate.source,
    )


def _joint_score_test(
    members: Sequence[_Member], linearisation: _Linearisation, squares: float, count: int
) -> MissingTerm | None:
    """Score test of terms of one kind at several joints together; None where it is not significant.

    Friction that the model of one joint of an arm lacks is usually missing at all of them. One by
    one, such terms are told apart poorly, and each needs a fit.

    Args:
        members: The terms, the most significant one first, each with one number.
        linearisation: Normal equations of parameters and candidates.
        squares: Sum of squared residuals.
        count: Number of candidates.
    """
    left = list(members)
    while len(left) >= FEWEST_JOINTS:
        columns = [column for each in left for column in linearisation.columns[each.index]]
        found = _tested(linearisation, columns)
        if found is None:
            return None
        impossible = [
            _impossible(each.candidate.tested, value[None])
            for each, value in zip(left, found.values, strict=True)
        ]
        if not any(impossible):
            break
        left = [each for each, flag in zip(left, impossible, strict=True) if not flag]
    else:
        return None
    if not _is_significant(found, squares, count):
        return None

    first, *others = left
    further = list(first.candidate.further)
    for each, value in zip(others, found.values[1:].tolist(), strict=True):
        number = each.candidate.tested[0]
        further.append(
            TermParameter(
                path=number.path,
                value=value,
                unit=number.unit,
                scale=_scale(value, number),
                is_size=True,
            )
        )
        further += each.candidate.further
    # Two drivers may act on the same joint.
    joints = tuple(dict.fromkeys(each.candidate.joint for each in left))
    return replace(
        first.term,
        description=f"{first.candidate.kind} at {len(joints)} joints",
        value=float(found.values[0]),
        sigmas=found.sigmas,
        share=found.explained / squares,
        further=tuple(further),
        more_added=tuple(each.term.added for each in others if each.term.added is not None),
        joints=joints,
    )


def _tested(linearisation: _Linearisation, columns: Sequence[int]) -> _ScoreTest | None:
    """Score test of some columns; None where the parameters may stand for one of them."""
    H, g = linearisation.H, linearisation.g
    others, tested = linearisation.others, np.array(columns)

    # Information and score after the parameters are eliminated.
    response = linearisation.inverse @ H[np.ix_(others, tested)]
    information = H[np.ix_(tested, tested)] - H[np.ix_(tested, others)] @ response
    score = g[tested] - g[others] @ response

    # The term is not identifiable separately from the parameters of the experiment.
    least = MIN_REMAINING_SHARE * np.diag(H)[tested]
    if not (np.diag(information) > least).all():
        return None

    step = -np.linalg.pinv(information, rcond=INVERSE_TOLERANCE, hermitian=True) @ score
    explained = float(-score @ step)
    return _ScoreTest(
        values=step / linearisation.norms[tested],
        explained=explained,
        sigmas=equivalent_sigmas(explained, len(tested)),
    )


def _is_significant(found: _ScoreTest, squares: float, count: int) -> bool:
    """Whether a test is significant among some candidates, and explains enough.

    A share above 1 means that the fit is too far from its minimum for a linear test.
    """
    is_unlikely = found.sigmas > -scipy.special.ndtri(0.5 * SIGNIFICANCE / count)
    return is_unlikely and MIN_EXPLAINED_SHARE < found.explained / squares < 1.0


def _impossible(numbers: Sequence[CandidateParameter], values: Array) -> bool:
    """Whether one of some numbers would have a value that makes no sense."""
    return any(
        number.positive and number.value + value < 0.0
        for number, value in zip(numbers, values, strict=True)
    )


def _scale(value: float, number: CandidateParameter) -> float:
    """Size of a number of a term: its estimate, or its small size where that is zero."""
    return abs(float(value)) or number.size


def equivalent_sigmas(explained: float, count: int) -> float:
    """Deviation of a normal variable that is as improbable as a chi-squared value.

    Args:
        explained: The value: the reduction of the sum of squared residuals.
        count: Degrees of freedom.
    """
    if count == 1:
        return float(np.sqrt(max(explained, 0.0)))
    with np.errstate(divide="ignore"):
        log_probability = np.log(scipy.special.chdtrc(count, max(explained, 0.0)))

    # Far out, the probability is below the smallest number. Then its expansion is exact enough
    # (Abramowitz and Stegun, Handbook of Mathematical Functions, 1964, 6.5.32).
    if not np.isfinite(log_probability):
        half, shape = 0.5 * explained, 0.5 * count
        log_probability = (shape - 1.0) * np.log(half) - half - scipy.special.gammaln(shape)
        log_probability += np.log1p((shape - 1.0) / half)
    return float(-scipy.special.ndtri_exp(log_probability - np.log(2.0)))
