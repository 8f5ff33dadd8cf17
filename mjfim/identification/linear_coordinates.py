"""Coordinates in which the equation of motion is linear.

They are the barycentric coordinates of the bodies whose whole inertia is unknown, and all other
parameters as they are: damping, dry friction, armature, stiffness and gains. Bodies are physical
where their pseudo-inertia is positive definite.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.model.inertia import (
    BARYCENTRIC_DERIVATIVES,
    INERTIA_PARAMETRISATIONS,
    BodyInertia,
    barycentric_of,
    inertia_difference,
    is_positive_definite,
    logcholesky_derivatives,
    logcholesky_factor,
    pseudo_inertia_of,
)
from mjfim.model.parameters import ParameterSet
from mjfim.model.targets import InertiaField

# Number of coordinates of an inertia.
COUNT = 10

# Share of the way to an inertia that no body has, which one step may go.
TO_BOUNDARY = 0.9

# Standard deviation of a weak prior on the logarithm of an inertia for which the model is no prior
# knowledge. It holds what the recordings do not determine.
HOLD_LOGARITHM = 10.0


@record
class UnknownBody:
    """A body whose whole inertia is unknown.

    Attributes:
        columns: (10,) indices in theta of its coordinates, in their order.
        is_logcholesky: True for log-Cholesky, False for barycentric coordinates.
        reference: (10,) log-Cholesky coordinates of the inertia in the model.
        sizes: (10,) natural magnitudes of changes of its parameters.
        linear_sizes: (10,) those of its barycentric coordinates.
        cad_sigma: Standard deviation of the logarithm of the inertia relative to the model's; None
            where the model's inertia is no prior knowledge.
    """

    columns: np.ndarray
    is_logcholesky: bool
    reference: Array
    sizes: Array
    linear_sizes: Array
    cad_sigma: float | None

    def linear(self, values: Array) -> Array:
        """(10,) barycentric coordinates of (10,) parameters."""
        if not self.is_logcholesky:
            return values
        factor = logcholesky_factor(values)
        return barycentric_of(factor @ factor.T)

    def values(self, linear: Array) -> Array:
        """(10,) parameters of (10,) barycentric coordinates, which are physical."""
        if not self.is_logcholesky:
            return linear
        inertia = INERTIA_PARAMETRISATIONS["barycentric"].inertia(linear)
        return INERTIA_PARAMETRISATIONS["logcholesky"].coordinates(inertia)

    def derivative(self, linear: Array) -> Array:
        """(10, 10) derivatives of the parameters by the barycentric coordinates."""
        return np.asarray(np.linalg.inv(self.linear_slopes(self.values(linear)).T))

    def physical_share(self, values: Array, step: Array) -> float:
        """Largest share, at most 1, of a step (10,) of the parameters that `moved` may take.

        Args:
            values: (10,) parameters at which the step begins.
            step: (10,) the step.
        """
        if not self.is_logcholesky or not step.any():
            return 1.0
        change = np.tensordot(step, logcholesky_derivatives(values), axes=1)
        inverse = np.linalg.inv(logcholesky_factor(values))
        smallest = float(np.linalg.eigvalsh(inverse @ change @ inverse.T)[0])
        share = min(1.0, -TO_BOUNDARY / smallest) if smallest < 0.0 else 1.0

        # Near a rod or a plate, rounding may leave no way.
        return share if self.is_physical_after(values, share * step) else 0.0

    def linear_slopes(self, values: Array) -> Array:
        """(10, 10) derivatives of the barycentric coordinates by each parameter, in rows."""
        if not self.is_logcholesky:
            return np.eye(COUNT)
        return barycentric_of(logcholesky_derivatives(values))

    def is_physical_after(self, values: Array, step: Array) -> bool:
        """Whether `moved` leads to a body with a volume, from parameters (10,) by a step (10,)."""
        if not self.is_logcholesky:
            return True
        return self.is_physical(self.linear(values) + step @ self.linear_slopes(values))

    def moved(self, values: Array, step: Array) -> Array:
        """(10,) parameters after a physical step along a straight line of linear coordinates.

        Forces are linear along it, so that Gauss-Newton steps err far less than along a straight
        line of log-Cholesky coordinates.
        """
        if not step.any():
            return values
        return self.values(self.linear(values) + step @ self.linear_slopes(values))

    def is_physical(self, linear: Array) -> bool:
        """Whether the barycentric coordinates: (10,) are those of a body with a volume."""
        if not is_positive_definite(pseudo_inertia_of(linear)):
            return False
        return _logcholesky(INERTIA_PARAMETRISATIONS["barycentric"].inertia(linear)) is not None

    @property
    def prior_sigma(self) -> float:
        """Standard deviation of the prior in a linear fit, very weak where none is stated."""
        return HOLD_LOGARITHM if self.cad_sigma is None else self.cad_sigma

    def linear_difference(self, linear: Array) -> tuple[Array, Array]:
        """See `inertia_difference`, from the model's inertia, by (10,) barycentric coordinates."""
        return inertia_difference(
            pseudo_inertia_of(linear), BARYCENTRIC_DERIVATIVES, self.reference
        )

    def difference(self, values: Array) -> tuple[Array, Array]:
        """See `inertia_difference`, from the model's inertia, by its (10,) parameters.

        Barycentric coordinates of a search need not be those of a body. Their difference is the
        linearised one, whose square is that of the metric to second order.
        """
        if not self.is_logcholesky:
            factor = logcholesky_factor(self.reference)
            model = barycentric_of(factor @ factor.T)
            _, jacobian = self.linear_difference(model)
            return jacobian @ (values - model), jacobian

        with np.errstate(over="ignore", invalid="ignore"):
            factor = logcholesky_factor(values)
            pseudo_inertia = factor @ factor.T
            derivatives = logcholesky_derivatives(values)
        if not np.isfinite(derivatives).all() or not np.isfinite(pseudo_inertia).all():
            return np.full(COUNT, np.inf), np.zeros((COUNT, COUNT))
        return inertia_difference(pseudo_inertia, derivatives, self.reference)


def unknown_bodies(parameters: ParameterSet) -> tuple[UnknownBody, ...]:
    """Bodies all of whose inertial coordinates are parameters without bounds.

    Points, rods and plates, which have no log-Cholesky coordinates, are left out.

    Args:
        parameters: The parameters.
    """
    columns: dict[tuple[int, str], dict[int, int]] = {}
    for j, parameter in enumerate(parameters.parameters):
        if len(parameter.targets) != 1 or np.isfinite(parameter.bounds).any():
            continue
        target = parameter.targets[0]
        field = target.field
        if isinstance(field, InertiaField) and target.scale == 1.0 and target.offset == 0.0:
            key = field.body, field.parametrisation
            columns.setdefault(key, {})[field.component] = j

    found = []
    for (body, kind), places in columns.items():
        if len(places) < COUNT or kind == "central":
            continue
        inertia = INERTIA_PARAMETRISATIONS[kind].inertia(parameters.nominal[kind, body])
        reference = _logcholesky(inertia)
        if reference is None:
            continue
        order = np.array([places[i] for i in range(COUNT)], dtype=np.intp)
        found.append(
            UnknownBody(
                columns=order,
                is_logcholesky=kind == "logcholesky",
                reference=reference,
                sizes=INERTIA_PARAMETRISATIONS[kind].magnitudes(inertia),
                linear_sizes=INERTIA_PARAMETRISATIONS["barycentric"].magnitudes(inertia),
                cad_sigma=parameters.parameters[int(order[0])].cad_prior,
            )
        )
    return tuple(found)


def _logcholesky(inertia: BodyInertia) -> Array | None:
    """(10,) log-Cholesky coordinates; None where the inertia has none."""
    try:
        return INERTIA_PARAMETRISATIONS["logcholesky"].coordinates(inertia)
    except (ValueError, np.linalg.LinAlgError):
        return None


@record
class LinearCoordinates:
    """The p parameters in linear coordinates x.

    Attributes:
        bodies: Bodies with barycentric coordinates in x.
        sizes: (p,) sizes of x.
    """

    bodies: tuple[UnknownBody, ...]
    sizes: Array

    @staticmethod
    def of(parameters: ParameterSet, theta: Array) -> LinearCoordinates:
        """The linear coordinates of parameters.

        Args:
            parameters: The parameters.
            theta: (p,) parameters at which a search starts; bodies that are not physical there do
                not have to be physical.
        """
        sizes = np.array(parameters.magnitude)
        bodies = tuple(
            body
            for body in unknown_bodies(parameters)
            if body.is_physical(body.linear(theta[body.columns]))
        )
        for body in bodies:
            sizes[body.columns] = body.linear_sizes
        return LinearCoordinates(bodies=bodies, sizes=sizes)

    def linear(self, theta: Array) -> Array:
        """(p,) linear coordinates of parameters theta: (p,)."""
        x = np.array(theta)
        for body in self.bodies:
            x[body.columns] = body.linear(theta[body.columns])
        return x

    def theta(self, x: Array) -> Array:
        """(p,) parameters at linear coordinates x: (p,)."""
        theta = np.array(x)
        for body in self.bodies:
            theta[body.columns] = body.values(x[body.columns])
        return theta

    def derivative(self, x: Array) -> Array:
        """(p, p) derivatives of the parameters by the linear coordinates x: (p,)."""
        blocks = np.eye(len(x))
        for body in self.bodies:
            blocks[np.ix_(body.columns, body.columns)] = body.derivative(x[body.columns])
        return blocks

    def slopes(self, differences: Array, moves: Array) -> Array:
        """Slopes of rows by the linear coordinates from differences along moves.

        They are exact for moves of any length where the rows are linear.

        Args:
            differences: (R, p) differences of the rows along each move.
            moves: (p, p) moves of the linear coordinates, one in each column.

        Returns:
            (R, p) slopes.
        """
        slopes = np.array(differences)
        plain = np.ones(len(moves), dtype=bool)
        for body in self.bodies:
            own = moves[np.ix_(body.columns, body.columns)]

            # Rows and columns are scaled, since the coordinates differ in their units.
            rows = np.abs(own).max(axis=1, keepdims=True)
            columns = np.abs(own).max(axis=0, keepdims=True)
            scaled = own / np.sqrt(rows * columns)
            weighted = differences[:, body.columns] / np.sqrt(columns)
            solved = scipy.linalg.solve(scaled.T, weighted.T).T
            slopes[:, body.columns] = solved / np.sqrt(rows[:, 0])
            plain[body.columns] = False
        places = np.flatnonzero(plain)
        slopes[:, places] /= moves[places, places]
        return slopes


# ---- priors on the inertias of some bodies


def cad_bodies(parameters: ParameterSet) -> tuple[UnknownBody, ...]:
    """Bodies whose inertias have a prior from the model, each with its standard deviation."""
    return tuple(body for body in unknown_bodies(parameters) if body.cad_sigma is not None)


def columns_of(bodies: Sequence[UnknownBody]) -> np.ndarray:
    """Indices in theta of all coordinates of some bodies, ascending."""
    return np.sort(np.array([body.columns for body in bodies], dtype=np.intp).ravel())


def cad_rows(bodies: Sequence[UnknownBody], theta: Array, *, linear: bool = False) -> Array:
    """Rows of the least-squares problem of the priors on the inertias of b bodies.

    Args:
        bodies: The bodies.
        theta: (p,) parameters [theta-unit], or linear coordinates of them.
        linear: True for linear coordinates.

    Returns:
        (10 b, p+1) rows `[J, r]`, with residuals in standard deviations; residuals are infinite
        where an inertia is too large for the computer.
    """
    blocks = [np.zeros((0, len(theta) + 1))]
    for body in bodies:
        difference = body.linear_difference if linear else body.difference
        residual, jacobian = difference(theta[body.columns])
        rows = np.zeros((len(residual), len(theta) + 1))
        rows[:, body.columns] = jacobian
        rows[:, -1] = residual
        blocks.append(rows / body.prior_sigma)
    return np.concatenate(blocks)


def cad_information(bodies: Sequence[UnknownBody], theta: Array) -> Array:
    """(p, p) information of these priors about the parameters at theta: (p,)."""
    J = cad_rows(bodies, theta)[:, :-1]
    return J.T @ J
