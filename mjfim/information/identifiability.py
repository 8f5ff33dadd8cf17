"""Identifiability of the parameters of an experiment: along its trajectory, and along random ones.

Random trajectories show whether another control would help.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError, UnidentifiableError
from mjfim.information.criteria import SINGULAR_RATIO
from mjfim.information.fisher import FisherInformation
from mjfim.information.null_space import (
    CLEAR_SINGULAR_VALUE,
    COARSER_STEP_FACTOR,
    COLUMN_ERROR_FACTOR,
    ERROR_FACTOR,
    LEAST_EFFECT,
    LEAST_RELATIVE_EFFECT,
    ZERO_SINGULAR_VALUES,
    NullSpace,
    find_null_space,
    parameter_groups,
)
from mjfim.model.parameters import ParameterSet
from mjfim.plant.derivatives import SENSITIVITY_STEP
from mjfim.plant.noise import Noise
from mjfim.plant.plant import Plant
from mjfim.records.check import ParameterGroup, combination_matrix, groups_in_words
from mjfim.records.design import CombinationAccuracy
from mjfim.records.trajectory import Sensitivity, Trajectory

# Number of random trajectories that are tried.
PROBES = 3

# Relative error of rows that are taken from an information matrix.
ROW_ROUND_OFF = 1e-7

# An effect below this fraction of the strongest one in earlier experiments is round-off.
NEGLIGIBLE_EFFECT = 1e-6

# Number of samples of a trajectory whose single steps are tested first; if they leave a doubt, all
# samples are tested.
FEW_SAMPLES = 60

# Difference steps of the parameters for single engine steps, relative to the size of each
# parameter.
SINGLE_STEP_DIFFERENCES = (1e-4, 4e-4)

# Smallest divisor; it prevents a division by zero.
TINY = 1e-300

# An effect on a whole motion is certain if it exceeds this multiple of the derivatives' error.
CLEAR_EFFECT = 1e3


@dataclass(frozen=True, kw_only=True, eq=False)
class Identifiability:
    """Directions of the wanted parameters without effect on the measured outputs.

    Attributes:
        names: Names of the t wanted parameters.
        along_trajectory: Null space along the given trajectory.
        along_all: Common null space of the given and of random trajectories.
        groups_along_trajectory: Groups of parameters that the given trajectory cannot separate.
        groups_along_all: Groups of parameters that none of the trajectories can separate.
    """

    names: tuple[str, ...]
    along_trajectory: NullSpace
    along_all: NullSpace
    groups_along_trajectory: tuple[ParameterGroup, ...]
    groups_along_all: tuple[ParameterGroup, ...]

    @property
    def basis(self) -> Array | None:
        """(t, s) combinations that an experiment can identify; None if it can identify all."""
        return self.along_all.basis if self.along_all.count else None

    def combinations(
        self, information: FisherInformation, values: Array, before: Array, after: Array
    ) -> tuple[CombinationAccuracy, ...]:
        """Identifiable combinations with their standard deviations for two information matrices.

        Args:
            information: Computes standard deviations of combinations from an information matrix.
            values: (t,) values of the wanted parameters.
            before: (p, p) information of the first experiment.
            after: (p, p) information of the second experiment.

        Returns:
            Accuracies of the combinations; empty if every parameter is identifiable.
        """
        rows = combination_matrix(self.groups_along_all, self.names)
        words = [
            str(combination)
            for group in self.groups_along_all
            for combination in group.combinations
        ]
        initial, final = (
            information.combination_std(matrix, rows).tolist() for matrix in (before, after)
        )

        return tuple(
            CombinationAccuracy(expression=text, value=value, std_initial=first, std_final=last)
            for text, value, first, last in zip(
                words, (rows @ values).tolist(), initial, final, strict=True
            )
        )


# Rows of G along a motion, and their change with a longer difference step.
RowsAndError = tuple[Array, Array]


@dataclass(frozen=True, kw_only=True, eq=False)
class IdentifiabilityTest:
    """Test for combinations of parameters that the outputs of a plant do not depend on.

    Attributes:
        plant: The plant.
        parameters: The p unknown parameters.
        noise: Noise of the measured outputs.
        theta: (p,) parameter values.
        earlier: (p, p) information of earlier experiments, without the priors of the parameters.
        probes: Function that simulates a number of random controls; it leaves out trajectories that
            diverge.
        differentiated: Function that does `rows_along` for several trajectories, on workers for
            example; None for one after the other.
    """

    plant: Plant
    parameters: ParameterSet
    noise: Noise
    theta: Array
    earlier: Array
    probes: Callable[[int], Iterator[Trajectory]]
    differentiated: Callable[[Iterable[Trajectory]], Iterable[RowsAndError | None]] | None = None

    @property
    def prior(self) -> Array:
        """(p, p) information of earlier experiments and of the priors."""
        return self.parameters.prior_information + self.earlier

    def rows(self, sensitivity: Sensitivity) -> Array:
        """(n, p) whitened rows of G at the measured samples."""
        return self.noise.whitened_rows(sensitivity.G)

    def rows_along(self, trajectory: Trajectory) -> RowsAndError | None:
        """Differentiate a whole motion by the parameters.

        Args:
            trajectory: The motion.

        Returns:
            (n, p) whitened rows of G, and (n, p) their change with a longer difference step; None
            where a perturbed simulation diverges.
        """
        fine = self.plant.derivatives.sensitivity(self.theta, trajectory)
        return None if fine is None else _rows_and_error(self, trajectory, fine)

    def along(
        self,
        trajectory: Trajectory,
        sensitivity: Sensitivity,
        stop: Callable[[], bool] = lambda: False,
    ) -> Identifiability:
        """Test identifiability along a trajectory.

        Random trajectories are tested only if this trajectory leaves a doubt.

        Args:
            trajectory: The trajectory.
            sensitivity: Its sensitivities to the parameters.
            stop: Asked before every random trajectory; true leaves out the rest of them.

        Returns:
            The null spaces.
        """
        J = self.rows(sensitivity)
        single_steps = _single_step_null_space(self, [trajectory])

        # One difference step is enough if all singular values are far larger than round-off.
        quick = _null_space(self, [J], None, single_steps.directions)
        if quick.smallest > CLEAR_SINGULAR_VALUE and not quick.count:
            return _with_groups(self, quick, quick)

        J, error = _rows_and_error(self, trajectory, sensitivity)
        return _identifiability(self, trajectory, J, error, single_steps, stop)

    def of_rows(
        self,
        trajectory: Trajectory,
        J: Array,
        error: Array,
        stop: Callable[[], bool] = lambda: False,
    ) -> Identifiability:
        """Test identifiability from rows of G.

        Random trajectories are tested only if these rows leave a doubt.

        Args:
            trajectory: One of the trajectories to which the rows belong.
            J: (n, p) whitened rows of G.
            error: (n, p) their change with a longer difference step.
            stop: Asked before every random trajectory; true leaves out the rest of them.

        Returns:
            The null spaces.
        """
        single_steps = _single_step_null_space(self, [trajectory])
        return _identifiability(self, trajectory, J, error, single_steps, stop)


def require_visible(parameters: ParameterSet, prior: Array, J: Array) -> None:
    """Raise an error if a parameter cannot be identified from data with these rows of G.

    Args:
        parameters: The p unknown parameters.
        prior: (p, p) prior information.
        J: (n, p) whitened rows of G.

    Raises:
        UnidentifiableError: A combination of parameters has no effect on the rows.
    """
    every = np.arange(len(parameters))
    null = find_null_space(J, None, parameters.magnitude, parameters.scale, every, prior)
    if not null.count:
        return

    units = [parameter.unit for parameter in parameters.parameters]
    groups = parameter_groups(null, parameters.names, parameters.magnitude, units)
    raise UnidentifiableError(
        f"not every parameter is identifiable from this trajectory: {groups_in_words(groups)}"
    )


def _identifiability(
    test: IdentifiabilityTest,
    trajectory: Trajectory,
    J: Array,
    error: Array,
    single_steps: _SingleSteps,
    stop: Callable[[], bool],
) -> Identifiability:
    """Null space of given rows, and the part of it that remains with random trajectories.

    Args:
        test: The plant and its parameters.
        trajectory: One of the trajectories to which the rows belong.
        J: (n, p) whitened rows of G.
        error: (n, p) their change with a longer difference step.
        single_steps: What single steps of the trajectory show.
        stop: Asked before every random trajectory; true leaves out the rest of them.
    """
    directions = _hidden_from_rows(test, single_steps.directions, J, error)
    along_trajectory = _null_space(test, [J], [error], directions)
    if not along_trajectory.count or stop():
        return _with_groups(test, along_trajectory, along_trajectory)

    tried = list(itertools.takewhile(lambda _: not stop(), test.probes(PROBES)))
    shown = replace(single_steps, directions=directions)
    known = _single_step_null_space(test, [trajectory, *tried], shown).directions
    known = _hidden_from_rows(test, known, J, error)
    stack, errors = [J], [error]

    # Whole motions are differentiated only if single steps do not explain the null space.
    if known is None or along_trajectory.count > known.shape[1]:
        differentiated = test.differentiated or (lambda probes: map(test.rows_along, probes))
        for found in differentiated(itertools.takewhile(lambda _: not stop(), tried)):
            if found is not None:
                stack.append(found[0])
                errors.append(found[1])

    along_all = _null_space(test, stack, errors, known)
    return _with_groups(test, along_trajectory, along_all)


def _single_step_null_space(
    test: IdentifiabilityTest,
    trajectories: Sequence[Trajectory],
    known: _SingleSteps | None = None,
) -> _SingleSteps:
    """Directions without effect on single steps and their outputs.

    Such a direction changes no motion and no output. Single steps show this accurately, even if
    motions are chaotic.

    Args:
        test: The plant and its parameters.
        trajectories: Trajectories whose samples are tested.
        known: What single steps of the first trajectory show, or None where it is not known.

    Returns:
        The directions, none if no wanted parameter changes the model or if all steps diverge.
    """
    parameters = test.parameters
    inside = parameters.interest[parameters.changes_model[parameters.interest]]

    # Control laws remember what happened before a sample, so that only whole motions are tested.
    if not len(inside) or test.plant.laws is not None:
        return _SingleSteps(few=None, directions=None)

    # A few samples are tested first. Another sample may show an effect of the directions that have
    # none there, such as a contact that depends on them. One combination of them is tested at all
    # samples, and every parameter only where that combination has an effect.
    few = _step_effects(test, trajectories[:1], FEW_SAMPLES) if known is None else known.few
    if few is not None:
        others = trajectories[1:]
        directions = None if known is None else known.directions
        if directions is None:
            others = trajectories
            directions = _without_effect(test, few, inside)

        if not _has_effect(test, others, few, directions):
            return _SingleSteps(few=few, directions=_hidden_from_earlier(test, directions))

    longest = max(trajectory.samples for trajectory in trajectories)
    found = _step_effects(test, trajectories, longest)
    if found is None:
        return _SingleSteps(few=few, directions=None)

    directions = _without_effect(test, found, inside)
    return _SingleSteps(few=few, directions=_hidden_from_earlier(test, directions))


@dataclass(frozen=True, kw_only=True, eq=False)
class _StepEffects:
    """Effects of directions of theta on single steps of trajectories.

    Attributes:
        J: (n, m) effects, see `mjfim.plant.step_derivatives.StepEffects`.
        error: (n, m) their change with a longer difference step.
        output_sizes: (ny,) sizes of the outputs, or None where there are no sensors.
    """

    J: Array
    error: Array
    output_sizes: Array | None


@dataclass(frozen=True, kw_only=True, eq=False)
class _SingleSteps:
    """Effects of the parameters on single steps of trajectories.

    Attributes:
        few: Effects of each parameter at a few samples of the first trajectory; None where no
            parameter changes the model or all of these steps diverge.
        directions: (t, k) directions without effect on the steps, or None where there are no
            such parameters or steps.
    """

    few: _StepEffects | None
    directions: Array | None


def _step_effects(
    test: IdentifiabilityTest,
    trajectories: Sequence[Trajectory],
    most: int,
    *,
    directions: Array | None = None,
    output_sizes: Array | None = None,
) -> _StepEffects | None:
    """Effects on single steps; None if all trajectories diverge.

    Args:
        test: The plant and its parameters.
        trajectories: Trajectories whose samples are tested.
        most: Largest number of samples of each trajectory.
        directions: (m, p) directions of theta; None for each parameter alone.
        output_sizes: (ny,) sizes of the outputs; None for the largest effects of each trajectory.
    """
    stack, errors = [], []
    sizes = output_sizes
    for trajectory in trajectories:
        count = min(most, trajectory.samples)
        picked = np.unique(np.linspace(0, trajectory.samples - 1, count).astype(int))
        try:
            first, second = (
                test.plant.derivatives.one_step(
                    test.theta,
                    trajectory,
                    picked,
                    step,
                    directions=directions,
                    output_sizes=output_sizes,
                )
                for step in SINGLE_STEP_DIFFERENCES
            )
        except SimulationDivergedError:
            continue
        stack.append(first.rows)
        errors.append(second.rows - first.rows)
        sizes = first.output_sizes

    if not stack:
        return None
    return _StepEffects(J=np.concatenate(stack), error=np.concatenate(errors), output_sizes=sizes)


def _without_effect(test: IdentifiabilityTest, effects: _StepEffects, inside: np.ndarray) -> Array:
    """(t, k) directions of the parameters inside the model without effect on single steps."""
    parameters = test.parameters
    null = find_null_space(
        effects.J[:, inside],
        effects.error[:, inside],
        parameters.magnitude[inside],
        parameters.scale[inside],
        np.arange(len(inside)),
        np.zeros_like(test.prior),
    )
    directions = np.zeros((len(parameters.interest), null.count))
    directions[np.searchsorted(parameters.interest, inside)] = null.directions
    return directions


def _has_effect(
    test: IdentifiabilityTest,
    trajectories: Sequence[Trajectory],
    few: _StepEffects,
    directions: Array,
) -> bool:
    """Check whether directions have an effect on any single step.

    A random combination of them has an effect, almost surely, where one of them has.

    Args:
        test: The plant and its parameters.
        trajectories: Trajectories, all of whose samples are tested.
        few: Effects of each parameter at a few samples, to which an effect is compared.
        directions: (t, k) directions.

    Returns:
        True also where no step can be simulated.
    """
    k = directions.shape[1]
    if not k or not trajectories:
        return False

    interest = test.parameters.interest
    relative = directions / test.parameters.magnitude[interest][:, None]
    share = np.random.default_rng(0).standard_normal(k) / np.linalg.norm(relative, axis=0)
    combination = np.zeros((1, len(test.theta)))
    combination[0, interest] = directions @ share

    longest = max(trajectory.samples for trajectory in trajectories)
    found = _step_effects(
        test, trajectories, longest, directions=combination, output_sizes=few.output_sizes
    )
    if found is None:
        return True

    # The directions are as inaccurate as the effects from which they follow.
    effect = float(_root_mean_square(found.J)[0])
    error = float(_root_mean_square(found.error)[0])
    error += float(np.linalg.norm(combination[0] * _root_mean_square(few.error)))

    # A weak effect that is no larger than its error is round-off.
    sizes = test.parameters.magnitude
    strongest = float((sizes * _root_mean_square(few.J)).max(initial=0.0))
    weak = LEAST_RELATIVE_EFFECT * strongest * float(np.linalg.norm(combination[0] / sizes))
    if effect <= min(weak, COLUMN_ERROR_FACTOR * error):
        return False

    # Other effects are compared with those of the parameters that cancel in the combination.
    parts = max(float(np.linalg.norm(combination[0] * _root_mean_square(few.J))), TINY)
    return effect / parts > float(np.clip(ERROR_FACTOR * error / parts, *ZERO_SINGULAR_VALUES))


def _root_mean_square(rows: Array) -> Array:
    """(m,) root mean square of each column of rows: (n, m)."""
    return np.asarray(np.sqrt(np.mean(rows**2, axis=0)))


def _with_groups(
    test: IdentifiabilityTest, along_trajectory: NullSpace, along_all: NullSpace
) -> Identifiability:
    """Combine two null spaces with their groups of parameters."""
    parameters = test.parameters
    interest = parameters.interest
    names = tuple(parameters.names[j] for j in interest)
    size = parameters.magnitude[interest]
    units = [parameters.parameters[j].unit for j in interest]

    return Identifiability(
        names=names,
        along_trajectory=along_trajectory,
        along_all=along_all,
        groups_along_trajectory=parameter_groups(along_trajectory, names, size, units),
        groups_along_all=parameter_groups(along_all, names, size, units),
    )


def _null_space(
    test: IdentifiabilityTest,
    stack: Sequence[Array],
    errors: Sequence[Array] | None,
    known: Array | None,
) -> NullSpace:
    """Null space of the stacked rows and of the rows of earlier experiments.

    Args:
        test: The plant and its parameters.
        stack: (n, p) whitened rows of G of each trajectory.
        errors: Errors of these rows, or None.
        known: (t, k) directions that are known to have no effect, or None.
    """
    parameters = test.parameters
    before = _rows_of_information(test.earlier)
    error = None
    if errors is not None:
        error = np.concatenate([*errors, ROW_ROUND_OFF * np.abs(before)])

    return find_null_space(
        np.concatenate([*stack, before]),
        error,
        parameters.magnitude,
        parameters.scale,
        parameters.interest,
        test.prior,
        known=known,
    )


def _rows_of_information(information: Array) -> Array:
    """(n, p) rows J with J'J equal to an information matrix (p, p)."""
    values, vectors = np.linalg.eigh(information)
    largest = max(float(values[-1]), 0.0)
    kept = values > SINGULAR_RATIO * largest

    lengths = np.sqrt(values[kept])
    return np.asarray(lengths[:, None] * vectors.T[kept])


def _hidden_from_rows(
    test: IdentifiabilityTest, directions: Array | None, J: Array, error: Array
) -> Array | None:
    """Directions without effect on single steps that have none on a whole motion either.

    An effect that is negligible in one step may add up over the motion.

    Args:
        test: The plant and its parameters.
        directions: (t, k) directions without effect on single steps, or None.
        J: (n, p) whitened rows of G along the motion.
        error: (n, p) their change with a longer difference step.

    Returns:
        (t, j) combinations of the directions; None if there are no directions.
    """
    if directions is None or not directions.shape[1]:
        return directions

    interest = test.parameters.interest
    sizes = test.parameters.magnitude[interest][:, None]
    unit = directions / np.linalg.norm(directions / sizes, axis=0)

    # Motions that cannot be differentiated accurately, as chaotic ones, are no evidence.
    rounding = CLEAR_EFFECT * np.linalg.norm(error[:, interest] @ unit, 2)
    square = np.zeros((unit.shape[1], unit.shape[1]))
    effect = np.concatenate([J[:, interest] @ unit, square])
    _, values, V = np.linalg.svd(effect, full_matrices=False)
    return np.asarray(unit @ V[values <= max(LEAST_EFFECT, rounding)].T)


def _hidden_from_earlier(test: IdentifiabilityTest, directions: Array) -> Array:
    """Combinations of (t, k) directions without effect on earlier experiments."""
    if not test.earlier.any() or not directions.shape[1]:
        return directions

    parameters = test.parameters
    interest = parameters.interest
    sizes = parameters.magnitude[interest][:, None]
    unit = directions / np.linalg.norm(directions / sizes, axis=0)

    before = _rows_of_information(test.earlier)
    effect = before[:, interest] @ unit
    square = np.zeros((unit.shape[1], unit.shape[1]))
    _, values, V = np.linalg.svd(np.concatenate([effect, square]), full_matrices=False)

    strongest = np.linalg.norm(before * parameters.magnitude, 2)
    unseen = values <= max(LEAST_EFFECT, NEGLIGIBLE_EFFECT * strongest)
    return np.asarray(unit @ V[unseen].T)


def _rows_and_error(
    test: IdentifiabilityTest, trajectory: Trajectory, fine: Sensitivity
) -> tuple[Array, Array]:
    """Whitened rows of G (n, p), and their change with a longer difference step (n, p).

    The change is zero if the simulation with the longer step diverges.
    """
    J = test.rows(fine)
    step = COARSER_STEP_FACTOR * SENSITIVITY_STEP
    coarse = test.plant.derivatives.sensitivity(test.theta, trajectory, step)
    return J, np.zeros_like(J) if coarse is None else test.rows(coarse) - J
