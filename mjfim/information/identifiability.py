"""Identifiability of the parameters of an experiment: along its trajectory, and along random ones.

Random trajectories show whether another control would help.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError, UnidentifiableError
from mjfim.information.fisher import FisherInformation
from mjfim.information.null_space import (
    CLEAR_SINGULAR_VALUE,
    COARSER_STEP_FACTOR,
    LEAST_EFFECT,
    NullSpace,
    find_null_space,
    parameter_groups,
)
from mjfim.model.parameters import ParameterSet
from mjfim.plant.noise import Noise
from mjfim.plant.plant import Plant
from mjfim.plant.rollout_derivatives import SENSITIVITY_STEP
from mjfim.records.combinations import ParameterGroup, combination_matrix
from mjfim.records.design import CombinationAccuracy
from mjfim.records.trajectory import Sensitivity, Trajectory

# Number of random trajectories that are tried.
PROBES = 3

# Relative error of rows that are taken from an information matrix.
ROW_ROUND_OFF = 1e-7

# An effect below this share of the strongest one in earlier experiments is round-off.
NEGLIGIBLE_EFFECT = 1e-6

# Number of samples of a trajectory whose single steps are tested first, before all of them.
FEW_SAMPLES = 60

# Difference steps of the parameters for single engine steps, relative to the size of each
# parameter.
SINGLE_STEP_DIFFERENCES = (1e-4, 4e-4)


@dataclass(frozen=True, kw_only=True, eq=False)
class Identifiability:
    """Directions of the wanted parameters that nothing measured can show.

    Attributes:
        names: Names of the t wanted parameters.
        along_trajectory: Null space along the given trajectory.
        along_all: Null space that random trajectories share with it.
        groups_along_trajectory: The null space along the given trajectory in the names of the
            parameters.
        groups_along_all: The shared null space in the names of the parameters.
    """

    names: tuple[str, ...]
    along_trajectory: NullSpace
    along_all: NullSpace
    groups_along_trajectory: tuple[ParameterGroup, ...]
    groups_along_all: tuple[ParameterGroup, ...]

    @property
    def basis(self) -> Array | None:
        """(t, s) combinations that some experiment can show; None where every parameter can be shown."""
        return self.along_all.basis if self.along_all.count else None

    def combinations(
        self, information: FisherInformation, values: Array, before: Array, after: Array
    ) -> tuple[CombinationAccuracy, ...]:
        """Identifiable combinations with their standard deviations under two information matrices.

        Args:
            information: Turns an information matrix into standard deviations of combinations.
            values: (t,) values of the wanted parameters.
            before: (p, p) information of the first experiment.
            after: (p, p) information of the second one.
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


@dataclass(frozen=True, kw_only=True, eq=False)
class IdentifiabilityTest:
    """Test for parameters that the measurements of a plant cannot show.

    Attributes:
        plant: The plant.
        parameters: The p unknown parameters.
        noise: Noise of the measured outputs.
        theta: (p,) parameter values.
        earlier: (p, p) information of earlier experiments, without the priors of the parameters.
        probes: Simulates a number of random controls; trajectories that diverge are left out.
    """

    plant: Plant
    parameters: ParameterSet
    noise: Noise
    theta: Array
    earlier: Array
    probes: Callable[[int], Iterator[Trajectory]]

    @property
    def prior(self) -> Array:
        """(p, p) information of earlier experiments and of the priors."""
        return self.parameters.prior_information + self.earlier

    def rows(self, sensitivity: Sensitivity) -> Array:
        """(n, p) whitened rows of G at the measured samples."""
        return self.noise.whitened_rows(sensitivity.G)

    def along(self, trajectory: Trajectory, sensitivity: Sensitivity) -> Identifiability:
        """Test identifiability along a trajectory; along random ones only where that leaves a doubt.

        Args:
            trajectory: The trajectory.
            sensitivity: Its sensitivities to the parameters.
        """
        J = self.rows(sensitivity)
        single_steps = _single_step_null_space(self, [trajectory])

        # One difference step is enough where every singular value stands far above its round-off.
        quick = _null_space(self, [J], None, single_steps)
        if quick.smallest > CLEAR_SINGULAR_VALUE and not quick.count:
            return _with_groups(self, quick, quick)

        J, error = _rows_and_error(self, trajectory, sensitivity)
        return _identifiability(self, trajectory, J, error, single_steps)

    def of_rows(self, trajectory: Trajectory, J: Array, error: Array) -> Identifiability:
        """Test identifiability from rows of G; along random trajectories only where that leaves a doubt.

        Args:
            trajectory: One of the trajectories to which the rows belong.
            J: (n, p) whitened rows of G.
            error: (n, p) their change with a longer difference step.
        """
        return _identifiability(
            self, trajectory, J, error, _single_step_null_space(self, [trajectory])
        )


def require_visible(parameters: ParameterSet, prior: Array, J: Array) -> None:
    """Raise where a parameter cannot be identified from data with these rows of G.

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
    listed = "; ".join(str(group) for group in groups)
    raise UnidentifiableError(f"this trajectory does not show every parameter: {listed}")


def _identifiability(
    test: IdentifiabilityTest,
    trajectory: Trajectory,
    J: Array,
    error: Array,
    single_steps: Array | None,
) -> Identifiability:
    """Null space of given rows, and the part of it that random trajectories leave.

    Args:
        test: The plant and its parameters.
        trajectory: One of the trajectories to which the rows belong.
        J: (n, p) whitened rows of G.
        error: (n, p) their change with a longer difference step.
        single_steps: (t, k) directions without effect on single steps, or None.
    """
    along_trajectory = _null_space(test, [J], [error], single_steps)
    if not along_trajectory.count:
        return _with_groups(test, along_trajectory, along_trajectory)

    tried = list(test.probes(PROBES))
    known = _single_step_null_space(test, [trajectory, *tried])
    stack, errors = [J], [error]

    # Whole motions are differentiated only where single steps do not explain the null space
    # already.
    if known is None or along_trajectory.count > known.shape[1]:
        for probe in tried:
            fine = test.plant.derivatives.sensitivity(test.theta, probe)
            if fine is None:
                continue
            rows, change = _rows_and_error(test, probe, fine)
            stack.append(rows)
            errors.append(change)

    along_all = _null_space(test, stack, errors, known)
    return _with_groups(test, along_trajectory, along_all)


def _single_step_null_space(
    test: IdentifiabilityTest, trajectories: Sequence[Trajectory]
) -> Array | None:
    """Directions without effect on single steps and their outputs, (t, k); None without a parameter inside the model.

    Such a direction moves nothing, whatever is measured. Single steps show it exactly, even where
    motions are chaotic.
    """
    parameters = test.parameters
    inside = parameters.interest[parameters.changes_model[parameters.interest]]
    if not len(inside):
        return None

    no_prior = np.zeros_like(test.prior)
    longest = max(trajectory.samples for trajectory in trajectories)

    # A few samples first: where they leave a direction open, a contact between them may still show
    # it.
    for most in (FEW_SAMPLES, longest):
        found = _step_effects(test, trajectories, most)
        if found is None:
            return None
        J, error = found[0][:, inside], found[1][:, inside]
        step, scale = parameters.magnitude[inside], parameters.scale[inside]
        null = find_null_space(J, error, step, scale, np.arange(len(inside)), no_prior)
        if not null.count:
            break

    directions = np.zeros((len(parameters.interest), null.count))
    directions[np.searchsorted(parameters.interest, inside)] = null.directions
    return _hidden_from_earlier(test, directions)


def _step_effects(
    test: IdentifiabilityTest, trajectories: Sequence[Trajectory], most: int
) -> tuple[Array, Array] | None:
    """Effects of the parameters on single steps, and their error; None where all trajectories diverge.

    Args:
        test: The plant and its parameters.
        trajectories: Trajectories whose samples are looked at.
        most: Largest number of samples of each.

    Returns:
        (n, p) effects and (n, p) their change with a longer difference step.
    """
    stack, errors = [], []
    for trajectory in trajectories:
        count = min(most, trajectory.samples)
        picked = np.unique(np.linspace(0, trajectory.samples - 1, count).astype(int))
        try:
            first, second = (
                test.plant.derivatives.one_step(test.theta, trajectory, picked, step)
                for step in SINGLE_STEP_DIFFERENCES
            )
        except SimulationDivergedError:
            continue
        stack.append(first)
        errors.append(second - first)

    return (np.concatenate(stack), np.concatenate(errors)) if stack else None


def _with_groups(
    test: IdentifiabilityTest, along_trajectory: NullSpace, along_all: NullSpace
) -> Identifiability:
    """Two null spaces in the names of the wanted parameters."""
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
    """Null space of stacked rows together with those of earlier experiments. known: (t, k) directions found otherwise."""
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
    """(n, p) rows whose squares add up to an information matrix (p, p)."""
    values, vectors = np.linalg.eigh(information)
    kept = values > 1e-14 * max(float(values[-1]), 0.0)
    return np.asarray(np.sqrt(values[kept])[:, None] * vectors.T[kept])


def _hidden_from_earlier(test: IdentifiabilityTest, directions: Array) -> Array:
    """Combinations of (t, k) directions that earlier experiments do not show either."""
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
    """Rows of G and their change with a longer step, which is all of them where the longer step diverges."""
    J = test.rows(fine)
    step = COARSER_STEP_FACTOR * SENSITIVITY_STEP
    coarse = test.plant.derivatives.sensitivity(test.theta, trajectory, step)
    return J, np.zeros_like(J) if coarse is None else test.rows(coarse) - J
