"""Search for the parameters with which the equation of motion holds along measured motions.

The equations are linearised in coordinates in which they are linear (`linear_coordinates`), by
differences that are exact for these. A weighted least-squares problem with bounds is solved, in
which bodies stay physical. Where the equations turn out not to be linear, as in lengths, they are
linearised again at the solution.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array, scaled_to_unit_diagonal
from mjfim.experiment.system import System
from mjfim.identification.averages import PER_WINDOW
from mjfim.identification.equation_priors import EquationPriors
from mjfim.identification.linear_coordinates import LinearCoordinates
from mjfim.identification.motion_equations import MotionEquations, Rows
from mjfim.identification.recorded_equations import EquationModel
from mjfim.identification.steady_bristles import StribeckParameters, stribeck_parameters
from mjfim.model.control_laws import LawField
from mjfim.model.parameters import ParameterSet, Target
from mjfim.model.sizes import model_length, translations
from mjfim.optimize.condensed_least_squares import bounded_least_squares, triangle

# Steps of differences, relative to the sizes of the parameters. Those of inertias may be long,
# because the slopes by linear coordinates are exact.
INERTIA_STEP = 0.1
OTHER_STEP = 1e-4

# Stribeck speeds that are tried, over the root mean square of the speed of the joint, and their
# ratio.
STRIBECK_SHARES = tuple(np.geomspace(0.03, 0.5, 8).tolist())
STRIBECK_RATIO = STRIBECK_SHARES[1] / STRIBECK_SHARES[0]

# Stribeck speeds explain rows equally well where the sums of squares differ by no more than the
# square of this number of standard deviations.
EQUAL_SIGMAS = 2.0

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

# Other starts end where this number of searches has led to costs that differ by this share.
AGREEING_STARTS = 4
AGREEING_SHARE = 0.1

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

# Rounds in which weights and parameters are found in turn, at most, and the relative change of the
# weights at which they end.
MAX_WEIGHT_ROUNDS = 10
WEIGHT_TOLERANCE = 0.05

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearisation:
    """Rows about a point, as linear functions of the linear coordinates.

    Attributes:
        x: (p,) linear coordinates of the point.
        rows: Rows there.
        slopes: (R, p) derivatives of the residuals.
    """

    x: Array
    rows: Rows
    slopes: Array

    def residual(self, x: Array) -> Array:
        """(R,) residuals that are predicted for linear coordinates: (p,)."""
        return np.asarray(self.rows.residual + self.slopes @ (x - self.x))


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundEquations:
    """Where a search ended.

    Attributes:
        linearisation: The last linearisation, moved to the solution.
        sigma: (E,) standard deviations of the equations.
        weights: (R,) weights of the rows.
        count: Number of linearisations.
        success: True where the last step changed nothing.
        speed_sigma: (k,) standard deviations of the Stribeck speeds, which are not searched.
    """

    linearisation: Linearisation
    sigma: Array
    weights: Array
    count: int
    success: bool
    speed_sigma: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class EquationAccuracy:
    """Accuracy of parameters that were fitted to the equations.

    Attributes:
        covariance: (p, p) covariance with all priors [theta-unit^2].
        undetermined: Indices of parameters that the recordings do not determine alone.
        determined: Number of combinations that they determine.
        condition: Condition number of the determined part of the regressor.
    """

    covariance: Array
    undetermined: np.ndarray
    determined: int
    condition: float


@dataclass(frozen=True, kw_only=True, eq=False)
class EquationSearch:
    """The least-squares problem of the equations.

    Attributes:
        equations: The equations.
        parameters: The parameters.
        coordinates: Their linear coordinates.
        impossible: Indices of parameters with which a body is not physical, by theta: (p,).
        active: Indices of the parameters that the equations contain, without Stribeck speeds.
        stribeck: Unknowns of the Stribeck effect, whose speeds are chosen from a few values.
        start: (p,) linear coordinates at which the search starts.
        priors: Priors on the linear coordinates.
        of_row: (R,) index of the equation of each row.
        rows_at_start: Rows at the start.
        forces: (E,) sizes of the forces of the equations [N or N m].
    """

    equations: MotionEquations
    parameters: ParameterSet
    coordinates: LinearCoordinates
    impossible: Callable[[Array], list[int]]
    active: np.ndarray
    stribeck: tuple[StribeckParameters, ...]
    start: Array
    priors: EquationPriors
    of_row: np.ndarray
    rows_at_start: Rows
    forces: Array

    @staticmethod
    def of(system: System, equations: MotionEquations, theta: Array) -> EquationSearch:
        """The problem at a start.

        Args:
            system: The system.
            equations: Its equations.
            theta: (p,) parameters at which the search starts.
        """
        parameters = system.parameters
        coordinates = LinearCoordinates.of(parameters, theta)
        contained = parameters.changes_model | (parameters.delay_derivative != 0.0)
        contained &= ~np.isin(parameters.names, system.experiment.fit.hold)
        contained &= ~_of_laws(parameters, equations.model)
        stribeck = tuple(
            each
            for each in stribeck_parameters(system)
            if contained[[each.excess, each.speed]].all()
        )
        contained[[each.speed for each in stribeck]] = False
        active, start = np.flatnonzero(contained), coordinates.linear(theta)
        rows = equations.rows(theta[None])[0]
        return EquationSearch(
            equations=equations,
            parameters=parameters,
            coordinates=coordinates,
            impossible=system.impossible,
            active=active,
            stribeck=stribeck,
            start=start,
            priors=EquationPriors(
                parameters=parameters, coordinates=coordinates, active=active, start=start
            ),
            of_row=equations.equation_of_row,
            rows_at_start=rows,
            forces=_force_sizes(system, rows, equations),
        )

    def run(self) -> FoundEquations:
        """The best result of a search from the start, and from others where that is poor.

        Only where the equations are not linear, another start can lead to another result.
        """
        start, speed_sigma = self._with_stribeck_speeds()
        moved = not np.array_equal(start, self.start)
        best = self._searched(start, self._rows(start) if moved else self.rows_at_start)
        if best.success and best.count == 1:
            return replace(best, speed_sigma=speed_sigma)

        # Where several starts have led to nearly the lowest cost, the model itself is poor, and
        # further starts would hardly lead to another one.
        costs = [self._relative_cost(best)]
        for other in self._other_starts(start):
            agreeing = sum(cost <= (1.0 + AGREEING_SHARE) * min(costs) for cost in costs)
            if min(costs) < POOR_COST * len(self.of_row) or agreeing >= AGREEING_STARTS:
                break
            found = self._searched(other, self._rows(other))
            costs.append(self._relative_cost(found))
            if costs[-1] == min(costs):
                best = found
        return replace(best, speed_sigma=speed_sigma)

    def _with_stribeck_speeds(self) -> tuple[Array, Array]:
        """The start with those of some Stribeck speeds that explain the rows best.

        Without an excess of the static friction, the rows do not depend on the Stribeck speed, and
        at a wrong speed the best excess may be none. Then a search would stay there. With an
        excess, averages over windows hardly tell a large one at a small speed from a small one at a
        large speed. So speeds are chosen from a few values that do not lead to extreme ones.
        Bristles of different joints hardly act on each other's rows, so that each value is tried
        at all joints together.

        Returns:
            (p,) the start, and (k,) standard deviations of the speeds.
        """
        if not self.stribeck:
            return self.start, np.zeros(0)

        # The linearisation without excess is that at every Stribeck speed, but for the columns of
        # the excess.
        columns = np.array([each.excess for each in self.stribeck])
        speeds = np.array([each.speed for each in self.stribeck])
        x = np.array(self.start)
        x[columns] = 0.0
        at = self._linearised(x, self._rows(x))
        weights = 1.0 / self.forces[self.of_row]

        dofs = np.array([each.dof for each in self.stribeck])
        own = np.array([equation.dof for equation in self.equations.equations])[self.of_row]
        usual = self._usual_speeds()[dofs]
        points = []
        for values in (self.start[speeds], *(share * usual for share in STRIBECK_SHARES)):
            moved = np.array(x)
            lower, upper = self.coordinates.lower[speeds], self.coordinates.upper[speeds]
            moved[speeds] = np.clip(values, lower, upper)
            found = self._linearised(moved, at.rows, columns, at.slopes)
            moved = self._minimum(found, weights, moved)
            squares = (weights * found.residual(moved)) ** 2
            points.append((moved, np.array([squares[own == dof].sum() for dof in dofs])))

        # Of the speeds that explain the rows of a joint equally well, the largest one needs the
        # smallest excess.
        counts = np.array([np.sum(own == dof) for dof in dofs]) / PER_WINDOW
        most = np.min([squares for _, squares in points], axis=0)
        most = most * (1.0 + EQUAL_SIGMAS**2 / np.maximum(counts, 1.0))
        best, sigma = np.array(self.start), np.zeros(len(self.stribeck))
        for k, each in enumerate(self.stribeck):
            equal = [moved for moved, squares in points if squares[k] <= most[k]]
            ordered = sorted(equal, key=lambda moved: float(moved[each.speed]))
            slowest, fastest = ordered[0], ordered[-1]
            best[each.speed], best[each.excess] = fastest[each.speed], fastest[each.excess]

            # The true speed may be anywhere between those that are tried besides them.
            half_step = np.sqrt(STRIBECK_RATIO)
            width = fastest[each.speed] * half_step - slowest[each.speed] / half_step
            sigma[k] = width / np.sqrt(12.0)
        return best, sigma

    def _usual_speeds(self) -> Array:
        """(nv,) root mean square of the measured speeds [m/s or rad/s]."""
        qvel = np.concatenate([each.motion.qvel for each in self.equations.recorded])
        return np.asarray(np.sqrt(np.mean(qvel**2, axis=0)))

    def _other_starts(self, first: Array) -> Iterator[Array]:
        """Starts with other values of the parameters that are no inertias of whole bodies.

        Args:
            first: (p,) linear coordinates of the first start.
        """
        plain = np.isin(np.arange(len(first)), self.active)
        for body in self.coordinates.bodies:
            plain[body.columns] = False

        rng = np.random.default_rng(0)
        points = sum(len(each.motion.t) for each in self.equations.recorded)
        evaluations = points * (len(self.active) + 1) * USUAL_LINEARISATIONS
        for _ in range(int(min(OTHER_STARTS, MOST_EVALUATIONS / evaluations))):
            factor = LARGEST_FACTOR ** rng.uniform(-1.0, 1.0, int(plain.sum()))
            start = np.array(first)
            start[plain] *= factor
            yield np.clip(start, self.coordinates.lower, self.coordinates.upper)

    def _relative_cost(self, found: FoundEquations) -> float:
        """Sum of squared residuals over the sizes of the forces."""
        residual = found.linearisation.rows.residual / self.forces[self.of_row]
        return float(residual @ residual)

    def _searched(self, start: Array, rows: Rows) -> FoundEquations:
        """Linearise and solve in turn, until the rows are those of the linearisation.

        The search begins with weights that do not depend on the start. Only where it has ended, the
        equations are weighted by their residuals: where the model still is wrong, these say little,
        and an equation without actuators could be made small together with its residuals.

        Args:
            start: (p,) linear coordinates at which it begins.
            rows: Rows there.
        """
        at = self._linearised(start, rows)
        weights = 1.0 / self.forces[self.of_row]
        is_weighted = False
        for count in range(1, MAX_LINEARISATIONS + 1):
            x = self._minimum(at, weights, at.x)
            rows = self._rows(x)
            if not is_weighted and self._agrees(at, rows, x, weights):
                is_weighted = True
                _, weights = self._weights(rows.residual)
            if is_weighted:
                x, weights = self._reweighted(at, weights, x)
                rows = self._rows(x)
                if self._agrees(at, rows, x, weights):
                    return self._found(at, x, rows, count, success=True)

            # A step that raises the cost is shortened.
            before = self._cost(at.rows.residual, at.x, weights)
            for _ in range(MAX_HALVINGS):
                if self._cost(rows.residual, x, weights) < before:
                    break
                x = 0.5 * (x + at.x)
                rows = self._rows(x)
            if not self._cost(rows.residual, x, weights) < before:
                return self._found(at, at.x, at.rows, count, success=False)
            at = self._linearised(x, rows)
        return self._found(at, at.x, at.rows, MAX_LINEARISATIONS, success=False)

    def _found(
        self, at: Linearisation, x: Array, rows: Rows, count: int, *, success: bool
    ) -> FoundEquations:
        """The result at x: (p,), whose rows are known.

        Bodies of which only a part of the inertia is unknown may be unphysical at the solution. It
        is then moved towards the start, as far as needed.
        """
        halvings = 0
        while halvings < MAX_HALVINGS and self.impossible(self.coordinates.theta(x)):
            x = 0.5 * (x + self.start)
            halvings += 1
        if halvings:
            success, rows = False, self._rows(x)
        sigma, weights = self._weights(rows.residual)
        return FoundEquations(
            linearisation=replace(at, x=x, rows=rows),
            sigma=sigma,
            weights=weights,
            count=count,
            success=success,
            speed_sigma=np.zeros(len(self.stribeck)),
        )

    # ---- rows

    def _rows(self, x: Array) -> Rows:
        """The rows at x: (p,)."""
        return self.equations.rows(self.coordinates.theta(x)[None])[0]

    def _linearised(
        self,
        x: Array,
        rows: Rows,
        columns: np.ndarray | None = None,
        known: Array | None = None,
    ) -> Linearisation:
        """Linearise about a point.

        Args:
            x: (p,) the point.
            rows: Rows there.
            columns: Indices of the parameters whose slopes are computed; None for all active ones.
            known: (R, p) slopes by the other ones; None for none.
        """
        active = self.active if columns is None else columns
        coordinates, parameters = self.coordinates, self.parameters
        theta = coordinates.theta(x)
        steps = OTHER_STEP * parameters.magnitude
        for body in coordinates.bodies:
            steps[body.columns] = body.sizes * (INERTIA_STEP if body.is_logcholesky else OTHER_STEP)

        # Steps go to the side that has more room.
        below, above = theta - parameters.lower, parameters.upper - theta
        steps = np.where(above >= below, steps, -steps)
        points = np.repeat(theta[None], len(active), axis=0)
        points[np.arange(len(points)), active] += steps[active]
        found = self.equations.rows(points)

        differences = np.zeros((len(rows.residual), len(x)))
        moves = np.diag(steps)
        for place, j in enumerate(active.tolist()):
            differences[:, j] = found[place].residual - rows.residual
            moves[:, j] = coordinates.linear(points[place]) - x
        slopes = coordinates.slopes(np.nan_to_num(differences), moves)
        if known is not None:
            slopes = np.where(np.isin(np.arange(len(x)), active), slopes, known)
        return Linearisation(x=x, rows=rows, slopes=slopes)

    def _agrees(self, at: Linearisation, rows: Rows, x: Array, weights: Array) -> bool:
        """Whether rows at x: (p,) are those that a linearisation predicts, with weights: (R,)."""
        predicted = at.residual(x)
        error = np.linalg.norm(weights * (rows.residual - predicted))
        residual = np.linalg.norm(weights * predicted)
        force = np.linalg.norm(weights * rows.explained)
        return bool(error <= max(LINEAR * residual, ROUNDING * force))

    def _cost(self, residual: Array, x: Array, weights: Array) -> float:
        """Sum of the squared rows and priors; infinite where a row is not finite."""
        if not np.isfinite(residual).all():
            return np.inf
        priors, _ = self.priors.all(x)
        return float(np.sum((weights * residual) ** 2) + priors @ priors)

    # ---- weights

    def _weights(self, residual: Array) -> tuple[Array, Array]:
        """(E,) standard deviations of the equations, and (R,) weights from residuals: (R,)."""
        sigma = np.ones(len(self.forces))
        weights = np.zeros(len(residual))
        for i, size in enumerate(self.forces.tolist()):
            own = self.of_row == i
            if not own.any():
                continue
            found = np.abs(residual[own])
            spread = float(np.quantile(found, USUAL_SHARE)) / LARGEST_USUAL
            within = np.minimum(found, LARGE_RESIDUAL * spread)
            least = max(LEAST_SIGMA * size, np.finfo(float).tiny)
            sigma[i] = max(float(np.sqrt(np.mean(within**2))), least)
            large = np.maximum(found / (LARGE_RESIDUAL * sigma[i]), 1.0)
            weights[own] = 1.0 / (sigma[i] * np.sqrt(large))
        return sigma, weights

    def _reweighted(self, at: Linearisation, weights: Array, begin: Array) -> tuple[Array, Array]:
        """(p,) coordinates and (R,) weights that are found in turn, from first ones."""
        x = begin
        for _ in range(MAX_WEIGHT_ROUNDS):
            x = self._minimum(at, weights, x)
            _, found = self._weights(at.residual(x))
            change = float(np.abs(found / weights - 1.0).max(initial=0.0))
            weights = found
            if change < WEIGHT_TOLERANCE:
                break
        return x, weights

    # ---- minimum of a linearisation

    def _minimum(self, at: Linearisation, weights: Array, begin: Array) -> Array:
        """(p,) minimum of the squared rows of a linearisation and of the priors.

        The rows are linear; only the priors on inertias are not. So Gauss-Newton steps need few
        iterations, where bodies stay physical along them.

        Args:
            at: The linearisation.
            weights: (R,) weights of its rows.
            begin: (p,) coordinates at which the search begins, inside the bounds.
        """
        # The triangle of the rows has equal inner products.
        rows = np.concatenate([at.slopes, at.rows.residual[:, None]], axis=1)
        R = triangle(weights[:, None] * rows)

        x = begin
        values, J = self._all_rows(at, R, x)
        cost = first = float(values @ values)
        for _ in range(MAX_STEPS):
            step = self._step(x, values, J)
            change = J @ step
            predicted = -float(change @ (2.0 * values + change))
            if not predicted > LEAST_DECREASE * first + RELATIVE_DECREASE * cost:
                break

            for _ in range(MAX_HALVINGS):
                moved = x + step
                if self.coordinates.are_physical(moved):
                    values, J = self._all_rows(at, R, moved)
                    if float(values @ values) < cost - MIN_DECREASE_RATIO * predicted:
                        break
                step, predicted = 0.5 * step, 0.5 * predicted
            else:
                break
            x, cost = moved, float(values @ values)
        return x

    def _step(self, x: Array, values: Array, J: Array) -> Array:
        """(p,) step to the minimum of linear rows, inside the bounds of the active parameters."""
        chosen, sizes = self.active, self.coordinates.sizes[self.active]
        step = np.zeros(len(x))
        step[chosen] = sizes * bounded_least_squares(
            J[:, chosen] * sizes,
            -values,
            np.minimum(self.coordinates.lower - x, 0.0)[chosen] / sizes,
            np.maximum(self.coordinates.upper - x, 0.0)[chosen] / sizes,
        )
        return step

    def _all_rows(self, at: Linearisation, R: Array, x: Array) -> tuple[Array, Array]:
        """Residuals of a triangle R and of the priors at x: (p,), and their derivatives."""
        of_data = R @ np.append(x - at.x, 1.0)
        priors, J = self.priors.all(x)
        return np.concatenate([of_data, priors]), np.concatenate([R[:, :-1], J])

    # ---- accuracy

    def accuracy(self, found: FoundEquations, correlation: Array) -> EquationAccuracy:
        """Accuracy of the parameters at a solution.

        Args:
            found: The solution.
            correlation: (E,) autocorrelation times of the residuals of the equations [rows].
        """
        x = found.linearisation.x
        weights = found.weights / np.sqrt(correlation)[self.of_row]
        D = self.coordinates.derivative(x)
        J = weights[:, None] * found.linearisation.slopes
        of_data = J.T @ J
        stated, weak = self.priors.stated(x)[1], self.priors.weak(x)[1]
        held = weak.T @ weak
        with_priors = of_data + held + stated.T @ stated

        # A parameter is determined where the recordings narrow the weak prior.
        by_speeds = self._error_by_speeds(found, J, weights, with_priors)
        with_data = D @ (_inverse(of_data + held, self.active) + by_speeds) @ D.T
        without = D @ _inverse(held, self.active) @ D.T
        sizes = self.parameters.magnitude
        std, prior = np.sqrt(np.diag(with_data)), np.sqrt(np.diag(without))
        is_wide = (std > DETERMINED_SIGMA * sizes) | (std > DETERMINED_SHARE * prior)
        is_wide &= np.isin(np.arange(len(x)), self.active)
        is_wide[[each.speed for each in self.stribeck]] = True
        covariance = D @ (_inverse(with_priors, self.active) + by_speeds) @ D.T

        relative = of_data * np.outer(self.coordinates.sizes, self.coordinates.sizes)
        known = int(np.sum(np.linalg.eigvalsh(relative) >= DETERMINED_SIGMA**-2))
        scaled, _ = scaled_to_unit_diagonal(of_data[np.ix_(self.active, self.active)])
        singular = np.sqrt(np.maximum(np.linalg.eigvalsh(scaled)[::-1], 0.0))
        least = max(float(singular[max(known, 1) - 1]), np.finfo(float).tiny)
        return EquationAccuracy(
            covariance=covariance,
            undetermined=np.flatnonzero(is_wide),
            determined=known,
            condition=float(singular[0]) / least,
        )

    def _error_by_speeds(
        self, found: FoundEquations, J: Array, weights: Array, information: Array
    ) -> Array:
        """(p, p) covariance by the errors of Stribeck speeds, which are not searched.

        Args:
            found: The solution.
            J: (R, p) weighted slopes by the linear coordinates.
            weights: (R,) weights of the rows.
            information: (p, p) information about the linear coordinates.
        """
        covariance = np.zeros_like(information)
        if not self.stribeck:
            return covariance

        at = found.linearisation
        speeds = np.array([each.speed for each in self.stribeck])
        by_speed = self._linearised(at.x, at.rows, speeds).slopes[:, speeds]
        sigma = found.speed_sigma

        # The least-squares solution moves so that it makes up for an error of a speed.
        moves = -_inverse(information, self.active) @ J.T @ (weights[:, None] * by_speed * sigma)
        covariance += moves @ moves.T
        covariance[speeds, speeds] += sigma**2
        return covariance


def _of_laws(parameters: ParameterSet, model: EquationModel) -> np.ndarray:
    """(p,) True for parameters that set only numbers of control laws that no equation contains."""
    contained = model.gain_rows

    def is_left_out(target: Target) -> bool:
        """Whether a target is a number of a law that no equation contains."""
        return isinstance(target.field, LawField) and not contained & set(target.field.rows)

    return np.array(
        [bool(p.targets) and all(map(is_left_out, p.targets)) for p in parameters.parameters],
        dtype=bool,
    )


def _inverse(information: Array, active: np.ndarray) -> Array:
    """(p, p) inverse of the information about active parameters; zero for the others."""
    found = np.zeros_like(information)
    chosen = np.ix_(active, active)
    scaled, scale = scaled_to_unit_diagonal(information[chosen])
    found[chosen] = np.linalg.inv(scaled) / np.outer(scale, scale)
    return found


def _force_sizes(system: System, rows: Rows, equations: MotionEquations) -> Array:
    """(E,) sizes of the forces of the equations, which hardly depend on the start [N or N m].

    They follow from the largest force of the actuators, and from the length of the model, which
    relates forces to moments. Without actuators, they follow from the forces at the start.
    """
    of_row = equations.equation_of_row
    arms = np.where(translations(system.model), 1.0, model_length(system.model))
    measured, needed = np.zeros(len(equations.equations)), np.zeros(len(equations.equations))
    for i in range(len(measured)):
        own = of_row == i
        if own.any():
            measured[i] = float(np.sqrt(np.mean(rows.measured[own] ** 2)))
            needed[i] = float(np.sqrt(np.mean(rows.explained[own] ** 2)))

    # The law of an actuator is compared with its own force.
    sizes = np.where(measured > 0.0, measured, needed)
    dofs = np.array([each.dof for each in equations.equations])
    is_dof = dofs >= 0
    of_dofs = measured if measured[is_dof].any() else needed
    largest = float((of_dofs[is_dof] / arms[dofs[is_dof]]).max(initial=0.0))
    sizes[is_dof] = largest * arms[dofs[is_dof]]
    return np.where(sizes > 0.0, sizes, 1.0)
