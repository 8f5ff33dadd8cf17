"""Tests of physical terms that a model may lack, on all data of a fit or on a part of them.

Most candidates (`mjfim/identification/assessment/term_candidates.py`) have score tests. Each of
their numbers has a column of sensitivities at the estimate. With the score g and the information I
of the numbers of a term, both after the parameters are eliminated, the term would reduce the sum of
squared residuals by `g' I^-1 g`, which is chi-squared distributed where the model is complete, and
its estimated size is `-I^-1 g`. The columns are those of an extended model that has many of them.

Terms that change the coordinates of the model, such as an elastic joint, have no such test. They
are screened by simulations with some of their values.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, ModelError
from mjfim.experiment.system import System
from mjfim.identification.assessment.term_candidates import (
    LINEARISATION_SIZE,
    Candidate,
    candidates_of,
)
from mjfim.identification.fit_problem import FitProblem, with_suitable_differences
from mjfim.identification.search import of_subset
from mjfim.identification.segments import (
    KnownActivations,
    Segment,
    free_directions,
    spread_over_data,
)
from mjfim.model.coordinates import state_names, tangent_names
from mjfim.model.elements import free_name
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.records.terms import Term, TermNumber, TermTestData

# Number of samples of a segment that tell enough. Where the part would contain fewer of each
# recording, it contains fewer recordings.
ENOUGH_SAMPLES = 500


def extended_problem(
    problem: FitProblem,
    at: UnknownValues,
    parameters: dict[str, Any],
    tables: dict[str, Any],
) -> tuple[FitProblem, UnknownValues] | None:
    """The problem of a model with further parameters and terms, and the solution in it.

    Rows, noise and initial states are those of the stated problem. New parameters have their
    guesses, new coordinates are at rest, and new activations follow from the recordings.

    Args:
        problem: The problem of some segments of the stated system.
        at: Its solution.
        parameters: Tables of the further parameters by name.
        tables: Tables of the library of terms by name.

    Returns:
        The problem and its unknowns; None where the model cannot have the terms.
    """
    system = problem.system
    try:
        extended = System.resolve(
            system.experiment.replace(parameters=parameters, terms=tables),
            threads=system.threads,
            source=system.source,
        )
    except (ExperimentError, ModelError):
        return None
    extended = extended.with_substeps(system.grid.substeps)
    parameters_of_both, plant = extended.parameters, extended.plant
    names = parameters_of_both.names
    places = [names.index(name) for name in system.parameters.names]
    theta, factors = np.array(parameters_of_both.guess), np.ones(len(names))
    theta[places] = at.theta
    if system.plant.step_factors is not None:
        factors[places] = system.plant.step_factors
    extended = replace(extended, plant=plant.with_step_factors(factors))

    # The rows are those of the solution; a delay as a parameter would let the segments begin
    # earlier.
    is_new = ~np.isin(np.arange(len(names)), places)
    directions = plant.initial_state_derivative[:, parameters_of_both.initial_deviations]
    if problem.free_starts:
        directions = free_directions(extended)
    wider = replace(
        problem,
        system=extended,
        segments=_extended_segments(problem, extended),
        start_directions=directions,
        parameters=parameters_of_both,
        shared=np.sort([*np.flatnonzero(is_new), *(places[j] for j in problem.shared)]),
        bounded=True,
        with_priors=True,
        pins=np.zeros((0, len(names))),
        pinned_at=parameters_of_both.guess,
    )
    # Private unknowns of new coordinates are zero.
    before, after = _private_names(problem), _private_names(wider)
    private = np.zeros((len(at.private), len(after)))
    private[:, [after.index(name) for name in before]] = at.private
    return wider, replace(at, theta=theta, private=private)


def _extended_segments(problem: FitProblem, system: System) -> tuple[Segment, ...]:
    """The segments of a problem with initial states of the extended system."""
    space = system.space
    known = KnownActivations.of(system)
    stated = state_names(problem.system.model)
    names = state_names(system.model)
    if stated == names:
        return problem.segments

    common = [names.index(name) for name in stated]
    places = space.nq + space.nv + np.array(known.addresses, dtype=np.intp)
    is_added = ~np.isin(places, common)

    segments = []
    for segment in problem.segments:
        start = np.array(system.plant.nominal_initial_state)
        start[common] = segment.start
        qvel = space.split(start)[1]
        values = known.at(
            problem.recordings[segment.recording], np.array([segment.begin]), qvel[None]
        )[0]
        start[places[is_added]] = values[is_added]
        segments.append(replace(segment, start=start))
    return tuple(segments)


def _private_names(problem: FitProblem) -> list[str]:
    """Names of the private unknowns of a segment."""
    if not problem.free_starts:
        return [problem.parameters.names[i] for i in problem.private]
    names = np.array(tangent_names(problem.system.model))
    directions = problem.start_directions
    return [str(names[np.flatnonzero(column)[0]]) for column in directions.T]


def part_of_data(problem: FitProblem, max_samples: float) -> tuple[FitProblem, np.ndarray]:
    """Some segments of each recording, and of these the first parts where that is still too much.

    First parts begin at the initial states of the problem. Other parts of a recording would begin
    at states that are unknown.

    Args:
        problem: Problem of all segments.
        max_samples: Number of samples of the part, at most.

    Returns:
        The problem of the part, that of all data where they are few enough, and the indices of its
        segments among all.
    """
    if problem.sample_count <= max_samples:
        return problem, np.arange(len(problem.segments))

    chosen = _spread_segments(problem, max_samples)
    part = problem.of_segments(chosen)
    if part.sample_count > max_samples:
        part = part.of_first_parts(max_samples / part.sample_count)
    return part, chosen


def _spread_segments(problem: FitProblem, max_samples: float) -> np.ndarray:
    """Indices of segments of as many recordings as possible, at least one of each of these."""
    samples = np.array([segment.samples for segment in problem.segments])
    of_recording = np.array([segment.recording for segment in problem.segments])

    # Of too many recordings, some have to be enough.
    recordings = np.unique(of_recording)
    least = min(float(samples.mean()), ENOUGH_SAMPLES)
    possible = max(int(max_samples / least), 1)
    if possible < len(recordings):
        recordings = recordings[spread_over_data(len(recordings), possible)]

    # The segments of each recording are spread over its time.
    share = max_samples / samples[np.isin(of_recording, recordings)].sum()
    chosen = []
    for recording in recordings:
        segments = np.flatnonzero(of_recording == recording)
        wanted = min(max(round(share * len(segments)), 1), len(segments))
        chosen.append(segments[spread_over_data(len(segments), wanted)])
    return np.concatenate(chosen)


# Probability, over all candidates, that one is reported although the model is complete.
SIGNIFICANCE = 1e-3

# A reported term explains at least this share of the sum of squared residuals, or moves a parameter
# by this number of its standard deviations: a term that matters may hide in much data.
MIN_EXPLAINED_SHARE = 2e-3
LEAST_MOVE = 1.0

# Power of a test with which the sizes of terms that it may miss are computed, and the smallest move
# of a parameter by such a term that is said, in standard deviations.
POWER = 0.95
LEAST_SAID_MOVE = 2.0

# Largest number of numbers that one linearisation tests; more of them are tested in groups.
MAX_TESTED = 100

# Largest number of terms that an estimate names.
MAX_NAMED_TERMS = 4

# Terms whose significances differ by less than this share explain the residuals equally well. The
# simplest one comes first, and then the first candidate, which rounding errors cannot change.
EQUAL_SIGNIFICANCE = 1e-2

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

# Factor between successive values of a screened term, and the largest number of them.
VALUE_FACTOR = 3.0
MAX_VALUES = 6

# Smallest reduction of the sum of squared residuals that counts, in squares of standard deviations.
# It does not depend on the number of joints: with white residuals, chance exceeds it with less than
# 1e-3 for all values of both terms at up to 140 joints.
MIN_REDUCTION = 25.0


@record
class TermTests:
    """Result of the tests of all terms that a model may lack.

    Attributes:
        terms: The significant terms, most significant first.
        data: The data on which they were tested; None before a test.
    """

    terms: tuple[Term, ...] = ()
    data: TermTestData | None = None

    @property
    def named(self) -> tuple[Term, ...]:
        """The terms that an estimate names: at most `MAX_NAMED_TERMS`, most significant first.

        A term at several joints stands for those of its single joints after it.
        """
        return _without_members(self.terms)[:MAX_NAMED_TERMS]

    @property
    def likely(self) -> tuple[Term, ...]:
        """The named terms that explain the residuals best and equally well, simplest first."""
        return _equal_to_best(self.named)

    def without(self, keys: Collection[str]) -> TermTests:
        """The tests without the terms that have some keys (`Term.key`)."""
        return replace(self, terms=tuple(term for term in self.terms if term.key not in keys))

    @property
    def remark(self) -> str:
        """Sentences about what was not tested, each with a space before it; empty for none."""
        if self.data is None:
            return ""
        about_data = "" if self.data.is_complete else str(self.data)
        sentences = (about_data, self.data.untested_sentence, self.data.impossible_sentence)
        return "".join(f" {sentence}" for sentence in sentences if sentence)


def find_missing_terms(problem: FitProblem, at: UnknownValues) -> TermTests:
    """Terms that would explain significant residuals.

    Args:
        problem: The least-squares problem of the estimate.
        at: Its solution.

    Returns:
        The significant terms that a selection may try, the most significant one first.
    """
    motion = problem.motion(at, problem.segments[0].recording, SPEED_SAMPLES)
    speeds = np.zeros(problem.system.space.nv)
    if motion is not None:
        speeds = np.sqrt(np.mean(motion.qvel**2, axis=0))
    candidates, impossible = candidates_of(problem.system, speeds)
    linear = [candidate for candidate in candidates if not candidate.screened]
    apart = dict.fromkeys(["", *(candidate.alone for candidate in linear)])
    groups = [
        group
        for kind in apart
        for group in in_groups([each for each in linear if each.alone == kind])
    ]
    largest = max((sum(len(each.tested) for each in group) for group in groups), default=0)
    columns = problem.column_count + problem.private_count + largest
    part, segments = part_of_data(problem, MAX_SIMULATED / columns)
    at = of_subset(at, segments)
    search = _TermSearch(
        problem=part,
        at=at,
        squares=2.0 * part.cost(at),
        count=sum(len(group) for group in groups),
    )
    found, untested, moved = search.by_score(groups)
    screened = (search.screened(candidate) for candidate in candidates if candidate.screened)
    found += filter(None, screened)
    names = problem.system.parameters.names
    return TermTests(
        terms=tuple(with_names(term, names) for term in first_terms(_by_significance(found))),
        data=TermTestData(
            share=part.sample_count / problem.sample_count,
            recordings=len({segment.recording for segment in part.segments}),
            count=len(problem.recordings),
            untested=tuple(dict.fromkeys(untested)),
            impossible=tuple(impossible),
            unseen=tuple(sorted(moved.items(), key=lambda each: -each[1][0])),
        ),
    )


def with_names(found: Term, taken: Iterable[str]) -> Term:
    """The term with names of its parameters, and with rounded sizes, which people read.

    Args:
        found: The term that tests have found.
        taken: Names of the parameters that the model has already.
    """
    used = set(taken)
    numbers = []
    for number in found.numbers:
        # Such as `pivot_damping` for `joint/pivot:damping`.
        place, _, field = number.path.partition(":")
        words = re.findall(r"\w+", place.partition("/")[2] or place) + re.findall(r"\w+", field)
        name = free_name("_".join(words), used)
        used.add(name)
        numbers.append(replace(number, name=name, scale=float(f"{number.scale:.2g}")))
    return replace(found, numbers=tuple(numbers))


def first_terms(ordered: Sequence[Term]) -> tuple[Term, ...]:
    """Select the terms that a selection tries or an estimate names from all significant ones.

    Args:
        ordered: All of them, most significant first.

    Returns:
        The first ones, and the first of those that no earlier one at several joints contains.
    """
    named = _without_members(ordered)[:MAX_NAMED_TERMS]
    keys = {term.key for term in (*ordered[:MAX_NAMED_TERMS], *named)}
    return tuple(term for term in ordered if term.key in keys)


def _without_members(ordered: Sequence[Term]) -> tuple[Term, ...]:
    """The terms in their order, without those that an earlier one at several joints contains."""
    return tuple(
        term
        for i, term in enumerate(ordered)
        if not any(earlier.contains(term) for earlier in ordered[:i])
    )


def _by_significance(terms: Sequence[Term]) -> list[Term]:
    """Terms, most significant first; of equal ones, those with fewest tables and numbers."""
    left, ordered = list(terms), []
    while left:
        equal = _equal_to_best(left)
        ordered += sorted(equal, key=lambda term: (len(term.tables), len(term.numbers)))
        left = [term for term in left if term not in equal]
    return ordered


def _equal_to_best(terms: Sequence[Term]) -> tuple[Term, ...]:
    """The terms that are as significant as the most significant one, in their order."""
    most = max((term.sigmas for term in terms), default=0.0)
    return tuple(term for term in terms if term.sigmas >= (1.0 - EQUAL_SIGNIFICANCE) * most)


def in_groups(candidates: Sequence[Candidate]) -> list[list[Candidate]]:
    """Divide candidates into groups that are linearised one after the other.

    Args:
        candidates: The candidates.

    Returns:
        Groups of at most `MAX_TESTED` numbers, in the order of the candidates. Terms of joints are
        together as far as possible, so that those of one kind can be tested together.
    """
    groups: list[list[Candidate]] = []
    is_divided = sum(len(candidate.tested) for candidate in candidates) > MAX_TESTED
    size, is_of_joint = MAX_TESTED, False
    for candidate in candidates:
        size += len(candidate.tested)
        begins = is_divided and bool(candidate.joint) and not is_of_joint
        if size > MAX_TESTED or begins:
            groups.append([])
            size = len(candidate.tested)
        groups[-1].append(candidate)
        is_of_joint = bool(candidate.joint)
    return groups


# Normal equations of the m tested numbers of some candidates after the parameters are eliminated:
# (m, m) information and (m,) gradient, for columns of length 1, (m,) lengths of the columns, (q, m)
# moves of the common unknowns by each number, in their standard deviations, and (q,) these standard
# deviations [theta-unit].
Linearisation = tuple[Array, Array, Array, Array, Array]


def _score_test(
    linearisation: Linearisation, columns: Sequence[int]
) -> tuple[Array, float, float] | None:
    """Score test of some columns; None where the parameters may stand for one of them.

    Returns:
        Estimated changes of the numbers, the reduction of the sum of squares, and the largest move
        of a parameter, in its standard deviations.
    """
    chosen = np.array(columns)
    information, score = linearisation[0][np.ix_(chosen, chosen)], linearisation[1][chosen]
    if not (np.diag(information) > MIN_REMAINING_SHARE).all():
        return None
    step = -np.linalg.pinv(information, rcond=INVERSE_TOLERANCE, hermitian=True) @ score
    move = np.abs(linearisation[3][:, chosen] @ step).max(initial=0.0)
    return step / linearisation[2][chosen], float(-score @ step), float(move)


@dataclass(frozen=True, kw_only=True, eq=False)
class _TermSearch:
    """Tests at the solution of a problem.

    Attributes:
        problem: The least-squares problem.
        at: Its solution.
        count: Number of candidates with score tests.
        squares: Sum of squared residuals at the solution.
    """

    problem: FitProblem
    at: UnknownValues
    count: int
    squares: float

    @property
    def threshold(self) -> float:
        """Smallest deviation of a significant term from zero, in its standard deviations."""
        return float(-scipy.special.ndtri(0.5 * SIGNIFICANCE / self.count))

    def by_score(
        self, groups: Sequence[Sequence[Candidate]]
    ) -> tuple[list[Term], list[str], dict[str, tuple[float, str]]]:
        """Terms whose score tests are significant, and descriptions of those without a test.

        By parameter, the largest move by a single number that the tests may miss is returned as
        well, as a share of the size of the parameter, with the term.

        Of variants of one term, the most significant one stands for it. Terms of one kind at
        several joints are tested together as well.
        """
        found: dict[str, Term] = {}
        of_joints: list[Term] = []
        untested: list[str] = []
        unseen: dict[str, tuple[float, str]] = {}
        parts = (self._linearised(group) for group in groups)
        for candidates, linearisation in itertools.chain.from_iterable(parts):
            if linearisation is None:
                untested += [candidate.description for candidate in candidates]
                continue
            self._add_unseen(unseen, linearisation, candidates)
            members: dict[str, int] = {}
            for index, candidate in enumerate(candidates):
                term = self._term(linearisation, candidates, [index])
                path = candidate.tested[0].path
                if term is not None and (path not in found or term.sigmas > found[path].sigmas):
                    found[path], members[path] = term, index
            ordered = sorted(members, key=lambda path: -found[path].sigmas)
            kinds: dict[str, list[int]] = {}
            for index in (members[path] for path in ordered):
                kinds.setdefault(candidates[index].kind, []).append(index)
            for kind, of_kind in kinds.items():
                together = self._term(linearisation, candidates, of_kind) if kind else None
                of_joints += [together] if together is not None and together.joints else []
        return [*found.values(), *of_joints], untested, unseen

    def _add_unseen(
        self,
        unseen: dict[str, tuple[float, str]],
        linearisation: Linearisation,
        candidates: Sequence[Candidate],
    ) -> None:
        """Add the largest moves of parameters by numbers that the tests may miss.

        A number for which parameters may stand has no test, and is left out.
        """
        information, _, lengths, moves, stds = linearisation
        effects = [(number, each.description) for each in candidates for number in each.tested]
        known = np.diag(information)
        tested = np.flatnonzero(known > MIN_REMAINING_SHARE)
        # No term is larger than its natural size.
        natural = np.array([number.size for number, _ in effects]) / LINEARISATION_SIZE * lengths
        missed = (self.threshold + scipy.special.ndtri(POWER)) / np.sqrt(known[tested])
        sizes = np.abs(moves[:, tested]) * np.minimum(missed, natural[tested])
        parameters = self.problem.system.parameters
        of_value = np.maximum(parameters.sizes(self.at.theta), parameters.magnitude)
        for j, std, row in zip(self.problem.parameter_of_column.tolist(), stds, sizes, strict=True):
            if row.max(initial=0.0) > LEAST_SAID_MOVE:
                words = effects[tested[row.argmax()]][1]
                largest = float(row.max() * std / of_value[j]), words
                name = parameters.names[j]
                unseen[name] = max(unseen.get(name, largest), largest)

    def _linearised(
        self, candidates: Sequence[Candidate]
    ) -> Iterator[tuple[Sequence[Candidate], Linearisation | None]]:
        """Linearise by a group of candidates, and by parts of it where one of them prevents it."""
        linearisation = self._linearise(candidates)
        if linearisation is not None or len(candidates) <= 1:
            yield candidates, linearisation
            return
        middle = len(candidates) // 2
        yield from self._linearised(candidates[:middle])
        yield from self._linearised(candidates[middle:])

    def _linearise(self, candidates: Sequence[Candidate]) -> Linearisation | None:
        """Linearise by parameters and candidates; None where the extended model diverges."""
        parameters: dict[str, Any] = {}
        tables: dict[str, Any] = {}
        for i, candidate in enumerate(candidates):
            # Variants of one term have the same name, but here each has its own.
            for name, table in candidate.tables.items():
                tables[f"?{i}{name}"] = table
            for k, number in enumerate(candidate.tested):
                target = re.sub("^term/", f"term/?{i}", number.path)
                parameters[f"?{i}.{k}"] = {
                    "target": target,
                    "guess": number.begin,
                    "scale": number.size,
                }
        extended = extended_problem(self.problem, self.at, parameters, tables)
        if extended is None:
            return None
        wider, begin = extended
        is_new = np.isin(wider.parameters.names, list(parameters))
        system = with_suitable_differences(wider.system, wider.recordings, wanted=is_new)
        wider = replace(wider, system=system)
        # Even the smallest size of a term may change the residuals. The readings follow it.
        before, after = self.problem.predict(self.at), wider.predict(begin)
        if before is None or after is None:
            return None
        shifted = tuple(
            replace(recording, y=recording.y + np.nan_to_num(with_terms - stated))
            for recording, stated, with_terms in zip(wider.recordings, before, after, strict=True)
        )
        condensed = replace(wider, recordings=shifted).condense(begin)
        if condensed is None:
            return None

        names = wider.parameters.names
        column_of = {names[j]: i for i, j in enumerate(wider.parameter_of_column.tolist())}
        own = [
            column_of[self.problem.system.parameters.names[j]]
            for j in self.problem.parameter_of_column.tolist()
        ]
        tested = np.array([column_of[name] for name in parameters])
        rows = np.concatenate([condensed.reduced_rows(), condensed.common_rows])
        norms = np.maximum(np.linalg.norm(rows[:, :-1], axis=0), SMALLEST_NORM)
        J = rows[:, :-1] / norms
        H, g = J.T @ J, J.T @ rows[:, -1]

        # The parameters are eliminated by the pseudo-inverse of their information.
        others = np.setdiff1d(np.arange(len(H)), tested)
        about_others = H[np.ix_(others, others)]
        inverse = np.linalg.pinv(about_others, rcond=INVERSE_TOLERANCE, hermitian=True)
        response = inverse @ H[np.ix_(others, tested)]
        information = H[np.ix_(tested, tested)] - H[np.ix_(tested, others)] @ response
        places = np.searchsorted(others, own)
        # A parameter that the data do not determine has no standard deviation.
        variances = np.diag(inverse)[places]
        stds = np.sqrt(np.where(variances > 0.0, variances, np.inf))
        moves = response[places] / stds[:, None]
        score = g[tested] - g[others] @ response
        return information, score, norms[tested], moves, stds / norms[own]

    def _term(
        self,
        linearisation: Linearisation,
        candidates: Sequence[Candidate],
        indices: Sequence[int],
    ) -> Term | None:
        """Score test of one candidate, or of several of one kind; None if it is not significant.

        Of several, those are left out that would have a value that makes no sense.
        """
        left = list(indices)
        ends = list(itertools.accumulate((len(each.tested) for each in candidates), initial=0))
        fewest = 1 if len(left) == 1 else FEWEST_JOINTS
        while len({candidates[i].joint for i in left}) >= fewest:
            columns = [column for i in left for column in range(ends[i], ends[i + 1])]
            found = _score_test(linearisation, columns)
            if found is None:
                return None
            values, explained, move = found
            changes = iter(values.tolist())
            numbers: list[TermNumber] = []
            possible = []
            for i in left:
                own = [(number, next(changes)) for number in candidates[i].tested]
                if not any(n.positive and n.value + change < 0.0 for n, change in own):
                    possible.append(i)
                of_size = [
                    TermNumber(
                        path=number.path,
                        value=change,
                        unit=number.unit,
                        scale=abs(change) or number.size,
                        is_size=True,
                    )
                    for number, change in own
                ]
                numbers += [*of_size, *candidates[i].further]
            if possible == left:
                break
            left = possible
        else:
            return None

        sigmas = equivalent_sigmas(explained, len(columns))
        share = explained / self.squares
        matters = share > MIN_EXPLAINED_SHARE or move > LEAST_MOVE
        if not (sigmas > self.threshold and matters and share < 1.0):
            return None
        members = [candidates[i] for i in left]
        # Two drivers may act on the same joint.
        joints = tuple(dict.fromkeys(member.joint for member in members))
        is_single = len(members) == 1
        words = (
            members[0].description if is_single else f"{members[0].kind} at {len(joints)} joints"
        )
        return Term(
            description=words,
            numbers=tuple(numbers),
            tables={name: table for each in members for name, table in each.tables.items()},
            sigmas=sigmas,
            share=share,
            joints=() if is_single else joints,
            source=members[0].source,
        )

    def _best_value(
        self, wider: FitProblem, begin: UnknownValues, first: float
    ) -> tuple[float, float]:
        """Value of the parameter `?` with the least sum of squares, and this sum.

        Values grow from a first one; the best is 0 where none of them is better than none.
        """
        place = wider.parameters.names.index("?")
        best, least = 0.0, self.squares
        for k in range(MAX_VALUES):
            theta = np.array(begin.theta)
            theta[place] = first * VALUE_FACTOR**k
            cost = 2.0 * wider.cost(replace(begin, theta=theta))
            if cost < least:
                best, least = float(theta[place]), cost
            elif best > 0.0:
                break
        return best, least

    def screened(self, candidate: Candidate) -> Term | None:
        """A term with its best value; None where no value is better than none."""
        (tested,) = candidate.tested
        extended = extended_problem(
            self.problem, self.at, {"?": {"target": tested.path}}, candidate.tables
        )
        if extended is None:
            return None
        best, least = self._best_value(*extended, tested.begin)
        reduction = self.squares - least
        if reduction < max(MIN_REDUCTION, MIN_EXPLAINED_SHARE * self.squares):
            return None
        number = TermNumber(
            path=tested.path, value=best, unit=tested.unit, scale=best, is_size=True
        )
        return Term(
            description=candidate.description,
            numbers=(number, *candidate.further),
            tables=candidate.tables,
            sigmas=float(np.sqrt(reduction)),
            share=reduction / self.squares,
            source=candidate.source,
        )


def equivalent_sigmas(explained: float, count: int) -> float:
    """Deviation of a normal variable that is as improbable as a chi-squared value.

    Args:
        explained: The chi-squared value.
        count: Its degrees of freedom.
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
