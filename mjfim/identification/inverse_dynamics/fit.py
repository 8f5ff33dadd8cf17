"""A fit of parameters to the equation of motion along measured motions (inverse dynamics).

The residuals are the forces that the measured motion needs, less those of the actuators (IDIM-LS;
Gautier, Janot & Vandanjon, A new closed-loop output error method for parameter identification of
robot dynamics, IEEE T-CST 2013; Leboutet et al., Inertial parameter identification in robotics: a
survey, Appl. Sci. 2021). They are linear in masses, inertias, damping, dry friction and most other
parameters, and in the barycentric coordinates of whole bodies. Where they are, one linearisation
leads from any start to the solution. Otherwise the search linearises in turn (Gauss and Newton) and
shortens steps that raise the cost. Each equation is weighted by its own residuals, of which large
ones count less (Huber). No motion is simulated.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from mjfim.arrays import Array, record, scaled_to_unit_diagonal
from mjfim.errors import MjfimError, RecordingError
from mjfim.experiment.arguments import checked
from mjfim.experiment.given import RecordingsLike, recordings_of
from mjfim.experiment.schema import ExperimentLike
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording, align, on_grid_of
from mjfim.identification.assessment.residual_tests import whiteness_of
from mjfim.identification.inverse_dynamics.equations import MotionEquations, residual_forces
from mjfim.identification.inverse_dynamics.motion import measured_forces
from mjfim.identification.linear_coordinates import LinearCoordinates, cad_rows, columns_of
from mjfim.model.control_laws import is_law_number
from mjfim.model.elements import model_length, translations
from mjfim.model.parameters import ParameterSet
from mjfim.optimize.condensed_least_squares import bounded_least_squares, triangle
from mjfim.parallel import one_blas_thread
from mjfim.records.estimate_parts import EquationFit, InverseDynamicsFit

# Steps of differences, relative to the sizes of the parameters. Those of inertias may be long,
# because the slopes by linear coordinates are exact.
INERTIA_STEP = 0.1
OTHER_STEP = 1e-4

# Largest number of linearisations.
MAX_LINEARISATIONS = 20

# Sum of squared residuals over the forces, per row, above which a search starts elsewhere as well:
# the residuals are a tenth of the forces.
POOR_COST = 0.01

# Number of other starts, and the largest factor by which their parameters differ. There are fewer
# where a search with this number of linearisations would take more evaluations in all.
OTHER_STARTS = 12
LARGEST_FACTOR = 10.0
USUAL_LINEARISATIONS = 8
MOST_EVALUATIONS = 3_000_000

# Difference of the rows from those of the linearisation, relative to the residuals and to the
# forces, below which the search has ended.
LINEAR = 0.01
ROUNDING = 1e-8

# Halvings of a step that raises the cost.
MAX_HALVINGS = 12

# Steps to the minimum of a linearisation, at most, and the decrease of the cost, relative to the
# first cost and to the present one, at which they end.
MAX_STEPS = 40
LEAST_DECREASE = 1e-14
RELATIVE_DECREASE = 1e-6

# Smallest decrease of the cost over the predicted one with which a step is accepted.
MIN_DECREASE_RATIO = 1e-4

# Rounds in which weights and parameters are found in turn.
WEIGHT_ROUNDS = 10

# Residuals above this multiple of their standard deviation count less (Huber).
LARGE_RESIDUAL = 2.5

# Share of the residuals from which their standard deviation is taken, and the largest of these for
# normal noise of standard deviation 1. More than half may be small, as those of a robot at rest.
USUAL_SHARE = 0.8
LARGEST_USUAL = 1.2816

# Smallest standard deviation of an equation, relative to its forces.
LEAST_SIGMA = 1e-9

# A combination is determined where its standard deviation is below this multiple of its size.
DETERMINED_SIGMA = 1.0

# A parameter is not determined where the recordings leave more than this share of the standard
# deviation of the weak prior.
DETERMINED_SHARE = 0.5

# Standard deviation of a weak prior about the start, in sizes of a coordinate. It holds what the
# recordings do not determine.
HOLD_SIGMA = 100.0


@record
class FoundEquations:
    """The point at which a search ended.

    Attributes:
        x: (p,) linear coordinates.
        rows: (3, R) the rows there (`MotionEquations.rows`).
        slopes: (R, p) their derivatives by the linear coordinates.
        sigma: (E,) standard deviations of the equations [N or N m].
        weights: (R,) weights of the rows.
        count: Number of linearisations.
        success: Whether no step lowers the cost.
    """

    x: Array
    rows: Array
    slopes: Array
    sigma: Array
    weights: Array
    count: int
    success: bool

    def residual(self, x: Array) -> Array:
        """(R,) residuals that the linearisation predicts for linear coordinates: (p,)."""
        return _residual(self.rows) + self.slopes @ (x - self.x)


def _residual(rows: Array) -> Array:
    """(R,) explained minus measured forces of rows: (3, R) [N or N m]."""
    return np.asarray(rows[0] - rows[1])


@record
class EquationSearch:
    """The least-squares problem of the equations.

    Attributes:
        equations: The equations.
        parameters: The parameters.
        coordinates: Coordinates in which the equations are linear.
        impossible: Bodies whose inertia is impossible at some parameters.
        active: Indices of the parameters that the equations contain.
        start: (p,) linear coordinates of the start.
        shapes: Values of parameters on which the equations hardly depend at the start, such as
            those of Stribeck speeds; each of them is tried.
        forces: (E,) sizes of the forces of the equations [N or N m].
    """

    equations: MotionEquations
    parameters: ParameterSet
    coordinates: LinearCoordinates
    impossible: Callable[[Array], list[int]]
    active: np.ndarray
    start: Array
    shapes: tuple[dict[int, float], ...]
    forces: Array

    @staticmethod
    def of(system: System, equations: MotionEquations, theta: Array) -> EquationSearch:
        """The problem at a start.

        Args:
            system: The system.
            equations: The equations along its recordings.
            theta: (p,) start.
        """
        parameters = system.parameters
        coordinates = LinearCoordinates.of(parameters, theta)
        contained = parameters.changes_model | (parameters.delay_derivative != 0.0)
        contained &= ~np.isin(parameters.names, system.experiment.fit.hold)
        contained &= [
            not all(is_law_number(target.field) for target in parameter.targets)
            or not parameter.targets
            for parameter in parameters.parameters
        ]
        rows = equations.rows(theta[None])[0]
        return EquationSearch(
            equations=equations,
            parameters=parameters,
            coordinates=coordinates,
            impossible=system.impossible,
            active=np.flatnonzero(contained),
            start=coordinates.linear(theta),
            shapes=tuple(_shapes(system, equations, contained)),
            forces=_force_sizes(system, rows, equations),
        )

    @property
    def of_row(self) -> np.ndarray:
        """(R,) index of the equation of each row."""
        return self.equations.places[1]

    def run(self) -> FoundEquations:
        """The best result of searches from the start with each shape, and from others if poor."""
        best, least = None, np.inf
        for start, is_needed in self._starts():
            # Where the equations are linear, no other start leads elsewhere.
            is_linear = best is not None and best.success and best.count == 1
            is_enough = is_linear or least < POOR_COST * len(self.of_row)
            if is_enough and not is_needed:
                break
            found = self._searched(start)
            scaled = _residual(found.rows) / self.forces[self.of_row]
            cost = float(scaled @ scaled)
            if best is None or cost < least:
                best, least = found, cost
        assert best is not None
        return best

    def _starts(self) -> Iterator[tuple[Array, bool]]:
        """Starts of searches, and whether they are needed although an earlier one fits well."""
        yield self.start, True
        for shape in self.shapes:
            moved = np.array(self.start)
            moved[list(shape)] = list(shape.values())
            yield np.clip(moved, self.parameters.lower, self.parameters.upper), True

        # Other values of the parameters that are no inertias of whole bodies.
        of_bodies = columns_of(self.coordinates.bodies)
        plain = np.setdiff1d(self.active, of_bodies)
        rng = np.random.default_rng(0)
        points = sum(len(each.motion.t) for each in self.equations.recorded)
        evaluations = points * (len(self.active) + 1) * USUAL_LINEARISATIONS
        for _ in range(int(min(OTHER_STARTS, MOST_EVALUATIONS / evaluations))):
            factor = LARGEST_FACTOR ** rng.uniform(-1.0, 1.0, len(plain))
            start = np.array(self.start)
            start[plain] *= factor
            yield np.clip(start, self.parameters.lower, self.parameters.upper), False

    def _searched(self, start: Array) -> FoundEquations:
        """Linearise and solve in turn, until the rows are those of the linearisation.

        All rows count by the sizes of their forces first, and by their residuals after that.
        """
        weights, is_robust = 1.0 / self.forces[self.of_row], False
        at = self._linearised(start, self._rows(start), weights)
        for count in range(1, MAX_LINEARISATIONS + 1):
            at = replace(at, count=count)
            x = self._minimum(at, weights, at.x)
            rows = self._rows(x)
            if not is_robust and self._agrees(at, rows, x, weights):
                is_robust = True
            if is_robust:
                for _ in range(WEIGHT_ROUNDS):
                    _, weights = self._weights(at.residual(x))
                    x = self._minimum(at, weights, x)
                rows = self._rows(x)
                if self._agrees(at, rows, x, weights):
                    return self._ended(at, x, rows, success=True)

            # A step that raises the cost is shortened.
            before = self._cost(_residual(at.rows), at.x, weights)
            for _ in range(MAX_HALVINGS):
                if self._cost(_residual(rows), x, weights) < before:
                    break
                x = 0.5 * (x + at.x)
                rows = self._rows(x)
            else:
                break
            at = self._linearised(x, rows, weights)
        return self._ended(at, at.x, at.rows, success=False)

    def _ended(self, at: FoundEquations, x: Array, rows: Array, *, success: bool) -> FoundEquations:
        """The result at x: (p,), whose rows are known; impossible bodies move towards the start."""
        halvings = 0
        while halvings < MAX_HALVINGS and self.impossible(self.coordinates.theta(x)):
            x = 0.5 * (x + self.start)
            halvings += 1
        if halvings:
            success, rows = False, self._rows(x)
        sigma, weights = self._weights(_residual(rows))
        return replace(at, x=x, rows=rows, sigma=sigma, weights=weights, success=success)

    # ---- rows

    def _rows(self, x: Array) -> Array:
        """The rows at x: (p,)."""
        return np.asarray(self.equations.rows(self.coordinates.theta(x)[None])[0])

    def _linearised(self, x: Array, rows: Array, weights: Array) -> FoundEquations:
        """Linearise about a point x: (p,) whose rows are known."""
        active, coordinates, parameters = self.active, self.coordinates, self.parameters
        theta = coordinates.theta(x)
        steps = OTHER_STEP * parameters.magnitude
        for body in coordinates.bodies:
            steps[body.columns] = body.sizes * (INERTIA_STEP if body.is_logcholesky else OTHER_STEP)
        # Steps go to the side that has more room.
        below, above = theta - parameters.lower, parameters.upper - theta
        steps = np.where(above >= below, steps, -steps)

        points = np.repeat(theta[None], len(active), axis=0)
        points[np.arange(len(points)), active] += steps[active]
        differences = np.zeros((rows.shape[1], len(x)))
        moves = np.diag(steps)
        for j, point, found in zip(active, points, self.equations.rows(points), strict=True):
            differences[:, j] = _residual(found) - _residual(rows)
            moves[:, j] = coordinates.linear(point) - x
        return FoundEquations(
            x=x,
            rows=rows,
            slopes=coordinates.slopes(np.nan_to_num(differences), moves),
            sigma=self.forces,
            weights=weights,
            count=0,
            success=False,
        )

    def _agrees(self, at: FoundEquations, rows: Array, x: Array, weights: Array) -> bool:
        """Whether rows at x: (p,) are those that a linearisation predicts, with weights: (R,)."""
        predicted = at.residual(x)
        error = np.linalg.norm(weights * (_residual(rows) - predicted))
        residual = np.linalg.norm(weights * predicted)
        force = np.linalg.norm(weights * rows[0])
        return bool(error <= max(LINEAR * residual, ROUNDING * force))

    def _cost(self, residual: Array, x: Array, weights: Array) -> float:
        """Sum of the squared rows and priors; infinite where a row is not finite."""
        if not np.isfinite(residual).all():
            return np.inf
        priors, _ = self._priors(x)
        return float(np.sum((weights * residual) ** 2) + priors @ priors)

    def _weights(self, residual: Array) -> tuple[Array, Array]:
        """(E,) standard deviations of the equations, and (R,) weights from residuals: (R,)."""
        sigma = np.ones(len(self.forces))
        weights = np.zeros(len(residual))
        for i in np.unique(self.of_row).tolist():
            own = self.of_row == i
            found = np.abs(residual[own])
            spread = float(np.quantile(found, USUAL_SHARE)) / LARGEST_USUAL
            within = np.minimum(found, LARGE_RESIDUAL * spread)
            least = max(LEAST_SIGMA * float(self.forces[i]), np.finfo(float).tiny)
            sigma[i] = max(float(np.sqrt(np.mean(within**2))), least)
            large = np.maximum(found / (LARGE_RESIDUAL * sigma[i]), 1.0)
            weights[own] = 1.0 / (sigma[i] * np.sqrt(large))
        return sigma, weights

    # ---- priors

    def _priors(self, x: Array) -> tuple[Array, Array]:
        """(r,) residuals of all priors at x: (p,), and their (r, p) derivatives."""
        stated, weak = self._stated_priors(x), self._weak_priors(x)
        return np.concatenate([stated[0], weak[0]]), np.concatenate([stated[1], weak[1]])

    def _stated_priors(self, x: Array) -> tuple[Array, Array]:
        """The priors of the experiment."""
        rows = self.parameters.prior_rows.reshape(-1, len(x))
        residual = rows @ (self.coordinates.theta(x) - self.parameters.guess)
        return residual, rows @ self.coordinates.derivative(x)

    def _weak_priors(self, x: Array) -> tuple[Array, Array]:
        """Weak priors about the model's inertias and about the start."""
        bodies = self.coordinates.bodies
        of_bodies = cad_rows(bodies, x, linear=True)
        held = np.setdiff1d(self.active, columns_of(bodies))
        weight = 1.0 / (HOLD_SIGMA * self.coordinates.sizes[held])
        return (
            np.concatenate([of_bodies[:, -1], weight * (x - self.start)[held]]),
            np.concatenate([of_bodies[:, :-1], np.eye(len(x))[held] * weight[:, None]]),
        )

    # ---- minimum of a linearisation

    def _minimum(self, at: FoundEquations, weights: Array, begin: Array) -> Array:
        """(p,) minimum of the squared rows of a linearisation and of the priors."""
        # The triangle of the rows has equal inner products.
        rows = np.concatenate([at.slopes, _residual(at.rows)[:, None]], axis=1)
        R = triangle(weights[:, None] * rows)

        def all_rows(x: Array) -> tuple[Array, Array]:
            """Residuals of the triangle and of the priors at x: (p,), and their derivatives."""
            priors, J = self._priors(x)
            residual = R @ np.append(x - at.x, 1.0)
            return np.concatenate([residual, priors]), np.concatenate([R[:, :-1], J])

        x, bodies = begin, self.coordinates.bodies
        chosen, sizes = self.active, self.coordinates.sizes[self.active]
        values, J = all_rows(x)
        cost = first = float(values @ values)
        for _ in range(MAX_STEPS):
            # The step to the minimum of linear rows, inside the bounds of the active parameters.
            step = np.zeros(len(x))
            step[chosen] = sizes * bounded_least_squares(
                J[:, chosen] * sizes,
                -values,
                np.minimum(self.parameters.lower - x, 0.0)[chosen] / sizes,
                np.maximum(self.parameters.upper - x, 0.0)[chosen] / sizes,
            )
            change = J @ step
            predicted = -float(change @ (2.0 * values + change))
            if not predicted > LEAST_DECREASE * first + RELATIVE_DECREASE * cost:
                break
            for _ in range(MAX_HALVINGS):
                moved = x + step
                if all(body.is_physical(moved[body.columns]) for body in bodies):
                    values, J = all_rows(moved)
                    if float(values @ values) < cost - MIN_DECREASE_RATIO * predicted:
                        break
                step, predicted = 0.5 * step, 0.5 * predicted
            else:
                break
            x, cost = moved, float(values @ values)
        return x

    # ---- accuracy

    def accuracy(
        self, found: FoundEquations, correlation: Array
    ) -> tuple[Array, list[int], int, float]:
        """Accuracy of the parameters at a solution.

        Args:
            found: The solution.
            correlation: (E,) number of correlated rows that count as one, by equation.

        Returns:
            (p, p) covariance of the parameters [theta-unit²], indices of those that the recordings
            do not determine, the number of combinations that they determine, and the condition
            number of these.
        """
        weights = found.weights / np.sqrt(correlation)[self.of_row]
        D = self.coordinates.derivative(found.x)
        J = weights[:, None] * found.slopes
        of_data = J.T @ J
        stated, weak = self._stated_priors(found.x)[1], self._weak_priors(found.x)[1]
        held = weak.T @ weak

        # A parameter is determined where the recordings narrow the weak prior.
        def std(information: Array) -> Array:
            """(p,) standard deviations of the parameters."""
            return np.sqrt(np.diag(D @ _inverse(information, self.active) @ D.T))

        with_data, without, sizes = std(of_data + held), std(held), self.parameters.magnitude
        is_wide = (with_data > DETERMINED_SIGMA * sizes) | (with_data > DETERMINED_SHARE * without)
        is_wide &= np.isin(np.arange(len(D)), self.active)

        relative = of_data * np.outer(self.coordinates.sizes, self.coordinates.sizes)
        known = int(np.sum(np.linalg.eigvalsh(relative) >= DETERMINED_SIGMA**-2))
        scaled, _ = scaled_to_unit_diagonal(of_data[np.ix_(self.active, self.active)])
        singular = np.sqrt(np.maximum(np.linalg.eigvalsh(scaled)[::-1], 0.0))
        least = max(float(singular[max(known, 1) - 1]), np.finfo(float).tiny)
        covariance = D @ _inverse(of_data + held + stated.T @ stated, self.active) @ D.T
        return covariance, np.flatnonzero(is_wide).tolist(), known, float(singular[0]) / least


def _shapes(
    system: System, equations: MotionEquations, contained: np.ndarray
) -> Iterator[dict[int, float]]:
    """Values of fields of terms that tests would try as well (`Term.shapes`), by parameter.

    Fields with a prior or with a factor keep what is stated.
    """
    stated = system.source.stated.model
    qvel = np.concatenate([each.motion.qvel for each in equations.recorded])
    speeds = np.sqrt(np.mean(qvel**2, axis=0))
    place = {
        target.path: j
        for j, parameter in enumerate(system.parameters.parameters)
        for target in parameter.targets
        if (len(parameter.targets), target.scale, target.offset) == (1, 1.0, 0.0)
        and contained[j]
        and parameter.prior is None
    }
    tried: list[list[dict[int, float]]] = []
    for name, term in system.source.terms.items():
        element = system.experiment.terms[name].joint
        if element is None:
            continue
        speed = float(speeds[int(system.model.joint(element).dofadr[0])])
        of_term = [
            {place[path]: x for key, x in values.items() if (path := f"term/{name}:{key}") in place}
            for values, _ in term.shapes(stated, element, speed)
        ]
        tried.append([shape for shape in of_term if shape])
    tried = [of_term for of_term in tried if of_term]
    for k in range(max(map(len, tried), default=0)):
        yield {j: x for of_term in tried for j, x in of_term[min(k, len(of_term) - 1)].items()}


def _inverse(information: Array, active: np.ndarray) -> Array:
    """(p, p) inverse of the information about active parameters; zero for the others."""
    found = np.zeros_like(information)
    chosen = np.ix_(active, active)
    scaled, scale = scaled_to_unit_diagonal(information[chosen])
    found[chosen] = np.linalg.inv(scaled) / np.outer(scale, scale)
    return found


def _force_sizes(system: System, rows: Array, equations: MotionEquations) -> Array:
    """(E,) sizes of the forces of the equations, which hardly depend on the start [N or N m]."""
    arms = np.where(translations(system.model), 1.0, model_length(system.model))
    needed, measured, _ = (np.sqrt(equations.mean_squares(each)) for each in rows)

    # The law of an actuator is compared with its own force.
    sizes = np.where(measured > 0.0, measured, needed)
    dofs = np.array([place for _, _, place in equations.equations])
    is_dof = np.array([bool(unit) for _, unit, _ in equations.equations])
    of_dofs = measured if measured[is_dof].any() else needed
    largest = float((of_dofs[is_dof] / arms[dofs[is_dof]]).max(initial=0.0))
    sizes[is_dof] = largest * arms[dofs[is_dof]]
    return np.where(sizes > 0.0, sizes, 1.0)


# Smallest number of rows that is enough for a fit, over the number of its parameters.
ROWS_PER_PARAMETER = 4.0


@checked
def inverse_dynamics(
    experiment: ExperimentLike,
    recordings: RecordingsLike,
    *,
    start: Array | None = None,
    threads: int | None = None,
) -> InverseDynamicsFit:
    """Fit parameters to the equation of motion along the measured motions.

    It needs the position or velocity of every degree of freedom, and the forces of the actuators,
    measured or by the model from the control in the log. It finds linear parameters from any start,
    in a small part of the time of `identify`. Noise in velocities and accelerations biases it more,
    and `identify` is the better estimator where a simulation follows the motion.

    Args:
        experiment: Model, parameters and noise; nothing else needs to be stated.
        recordings: Recordings to which the parameters are fitted.
        start: (p,) parameters at which the fit starts; default: the guess.
        threads: Threads for the engine; default: one per core.

    Returns:
        The fit.

    Raises:
        ExperimentError: Something is wrong in the experiment or in the arguments.
        RecordingError: A recording cannot be used; a degree of freedom was not measured.
    """
    system = System.resolve(experiment, threads=threads)
    logs = recordings_of(system, recordings)
    if not logs:
        raise RecordingError("inverse_dynamics needs at least one recording")

    begun = system.theta_of("start", start)
    system = on_grid_of(system, logs)
    aligned = [align(system, each) for each in logs]
    with one_blas_thread():
        found = fit_equations(system, aligned, begun)
        residuals = residual_forces(system, aligned, [found.theta] * len(aligned))
    return replace(found, residual_forces=residuals)


def fit_equations(
    system: System, recordings: Sequence[AlignedRecording], start: Array
) -> InverseDynamicsFit:
    """Fit the parameters of a system to the equation of motion along recordings.

    Args:
        system: The system on the grid of the recordings.
        recordings: The recordings.
        start: (p,) parameters at which the fit starts [theta-unit].

    Returns:
        The fit.

    Raises:
        ExperimentError: Control laws compute controls, and a force of such an actuator was not
            measured.
        RecordingError: A degree of freedom was not measured, or too little can be used.
    """
    forces, laws = measured_forces(system, recordings), system.laws
    system = system.without_laws()

    begun, steps = time.perf_counter(), system.plant.engine_steps
    parameters = system.parameters
    start = np.clip(start, parameters.lower, parameters.upper)
    equations = MotionEquations.of(system, recordings, start, forces=forces, laws=laws)
    search = EquationSearch.of(system, equations, start)
    rows, count = len(search.of_row), len(search.active)
    if not count:
        raise RecordingError(
            f"{recordings[0].name}: the equation of motion contains none of the parameters; "
            'remove fit.start = "inverse_dynamics"'
        )
    if rows < ROWS_PER_PARAMETER * count:
        raise RecordingError(
            f"{recordings[0].name}: the equation of motion has only {rows} rows for {count} "
            "parameters; rows near gaps, stops and contacts do not count: use longer recordings, "
            'or fit.start = "measured"'
        )

    found = search.run()
    taken = equations.system.plant.engine_steps + system.plant.engine_steps - steps
    return replace(_record(search, found), seconds=time.perf_counter() - begun, steps=taken)


def try_fit_equations(
    system: System, recordings: Sequence[AlignedRecording], start: Array
) -> InverseDynamicsFit | None:
    """The fit of `fit_equations` as a start that nobody asked for; None where it is of no use.

    It is not possible without measured motions, and without any force of actuators the equation of
    motion shows ratios of inertias and other forces only: small inertias make its residuals small.

    Args:
        system: The system on the grid of the recordings.
        recordings: The recordings.
        start: (p,) parameters at which the fit starts [theta-unit].
    """
    try:
        found = fit_equations(system, recordings, start)
    except (MjfimError, np.linalg.LinAlgError):
        return None
    has_forces = any(each.force > 0.0 for each in found.degrees_of_freedom)
    return found if has_forces else None


# ---- record


def _record(search: EquationSearch, found: FoundEquations) -> InverseDynamicsFit:
    """The record of a solution, without its time."""
    parameters = search.parameters
    fits = tuple(_equation_fits(search, found))
    times = {fit.name: fit.correlation for fit in fits}
    correlation = np.array([times.get(name, 1.0) for name, _, _ in search.equations.equations])
    covariance, unknown, determined, condition = search.accuracy(found, correlation)

    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    without_prior = [j for j in unknown if parameters.parameters[j].prior is None]
    std[without_prior] = np.inf
    absent = np.setdiff1d(np.arange(len(parameters)), [*search.active, *unknown])
    std[absent] = np.nan
    status = f"converged after {found.count} linearisations"
    if found.count == 1:
        status = "converged: the equation of motion is linear in the parameters"
    if not found.success:
        status = "not converged: no step lowers the residuals of the equation of motion any more"
    return InverseDynamicsFit(
        parameters=parameters.names,
        units=search.equations.system.units,
        theta=search.coordinates.theta(found.x),
        std=std,
        covariance=covariance,
        start=search.coordinates.theta(search.start),
        equations=fits,
        determined=determined,
        undetermined=tuple(parameters.names[j] for j in unknown),
        absent=tuple(parameters.names[j] for j in absent),
        condition=condition,
        iterations=found.count,
        converged=found.success,
        status=status,
        sizes=parameters.magnitude,
    )


def _equation_fits(search: EquationSearch, found: FoundEquations) -> Iterator[EquationFit]:
    """The fits of all equations that have rows."""
    equations, rows = search.equations, found.rows
    recording = equations.places[0]
    values = _residual(rows), rows[1], rows[2]
    residuals, measured, inertial = (np.sqrt(equations.mean_squares(each)) for each in values)
    for i, (name, unit, _) in enumerate(equations.equations):
        own = np.flatnonzero(search.of_row == i)
        if not len(own):
            continue
        residual = _residual(rows)[own] * found.weights[own]
        parts = [residual[recording[own] == k] for k in np.unique(recording[own])]
        yield EquationFit(
            name=name,
            unit=unit,
            residual=float(residuals[i]),
            size=float(max(measured[i], inertial[i])),
            rows=len(own),
            cutoff=1.0 / max(each.windows[i][2] for each in equations.recorded),
            sigma=float(found.sigma[i]),
            correlation=max(whiteness_of(name, parts).time, 1.0),
            force=float(measured[i]),
        )
