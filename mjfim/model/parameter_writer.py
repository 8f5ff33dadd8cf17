"""The only writer of parameter values into models.

Values are written into private copies in place, followed by `mj_setConst`. Values that need a
compile (sizes of geoms, functions of an MjSpec) are written into an MjSpec, which is compiled anew.
Tests compare both ways.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, listed
from mjfim.model.elements import element_name
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS
from mjfim.model.parameters import ParameterSet
from mjfim.model.targets import InertiaField, ModelField, RotationField, SpecField, TermField
from mjfim.model.variants import PlantModel

# Relative amount by which the largest principal moment of inertia may exceed the sum of the other
# two, because the moments of a plate or rod are often stated with few digits.
MOMENT_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class ParameterWriter:
    """Writes values theta: (p,) of a set of parameters into models."""

    parameters: ParameterSet

    def model(self, base: PlantModel | Any, theta: Array) -> Any:
        """A private copy of the base model with theta written into it.

        Args:
            base: A `PlantModel`, or an MjModel where nothing needs a compile.
            theta: (p,) values.

        Raises:
            ExperimentError: A function of the MjSpec fails.
            ModelError: The values do not compile, or change the layout of the state.
        """
        model = copy.copy(self.base(base, theta))
        self.write(model, theta)
        return base.refresh(model) if isinstance(base, PlantModel) else model

    def base(self, source: PlantModel | Any, theta: Array) -> Any:
        """The model into which theta can be written in place.

        It is compiled, and kept for later calls, where theta changes values that need a compile.
        """
        if not isinstance(source, PlantModel):
            return source

        needs_compile = self.parameters.needs_compile
        if not needs_compile.any():
            return source.model

        key = np.asarray(theta)[needs_compile].tobytes()
        return source.edited(key, lambda spec: self._edit(spec, source, theta))

    def write(self, model: Any, theta: Array) -> None:
        """Write theta: (p,) into a private model, in place.

        MuJoCo's derived constants are computed anew. Values that need a compile are not written
        here, but by `model`.
        """
        same_frame = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        for (kind, row), values in self._write_numbers(model, theta).items():
            if kind not in INERTIA_PARAMETRISATIONS:
                # A body or site is turned from its nominal orientation. MuJoCo skips the
                # orientation of sites whose frame coincides with their body's.
                quaternion = self.parameters.nominal[kind, row].copy()
                mujoco.mju_quatIntegrate(quaternion, values, 1.0)
                getattr(model, kind)[row] = quaternion
                if kind == "site_quat":
                    model.site_sameframe[row] = same_frame
                continue

            # With the central parametrisation, mass and centre of mass are written separately, as
            # numbers of their fields. MuJoCo skips inertial frames that coincide with the body's.
            inertia = INERTIA_PARAMETRISATIONS[kind].inertia(values)
            model.body_inertia[row], model.body_iquat[row] = inertia.principal_axes()
            if kind != "central":
                model.body_mass[row] = inertia.mass
                model.body_ipos[row] = inertia.com
            model.body_sameframe[row] = same_frame

        workspace = self.parameters.workspace
        if not workspace:
            workspace.append(mujoco.MjData(model))
        self.parameters.mocap.derive_constants(model, workspace[0])

    def unphysical_bodies(
        self, base: PlantModel | Any, theta: Array, rounding: float = MOMENT_ROUNDING
    ) -> list[tuple[tuple[int, ...], str]]:
        """Bodies whose inertia at theta is unphysical.

        Args:
            base: A `PlantModel`, or an MjModel where nothing needs a compile.
            theta: (p,) values.
            rounding: Share of the largest principal moment by which it may exceed the sum of the
                others.

        Returns:
            For each of these bodies the indices of the parameters that determine its inertia, and
            the fault in words.

        Raises:
            ModelError: MuJoCo refuses to compile the values.
        """
        columns_of_body: dict[int, list[int]] = {}
        of_moments = set[int]()
        for j, target in self.parameters.targets():
            field = target.field
            if isinstance(field, InertiaField):
                columns_of_body.setdefault(field.body, []).append(j)
            elif isinstance(field, ModelField) and field.array in ("body_mass", "body_inertia"):
                columns_of_body.setdefault(field.rows[0], []).append(j)
                if field.array == "body_inertia":
                    of_moments.add(field.rows[0])

        model = copy.copy(self.base(base, theta))
        parametrised = {
            body: (kind, values)
            for (kind, body), values in self._write_numbers(model, theta).items()
            if kind in INERTIA_PARAMETRISATIONS
        }

        found = []
        for body, columns in columns_of_body.items():
            # Moments that are no parameters are those of a model that MuJoCo has compiled.
            kind, values = parametrised.get(body, ("", np.zeros(0)))
            allowed = rounding if kind or body in of_moments else 1.0
            fault = _inertia_fault(model, body, kind, values, allowed)
            if fault:
                name = element_name(model, "body", body)
                found.append((tuple(dict.fromkeys(columns)), f"body {name!r} has {fault}"))
        return found

    def require_physical_bodies(self, base: PlantModel) -> None:
        """Raise ExperimentError if the guess or the true values make an inertia unphysical."""
        p = self.parameters
        for key, theta in (("guess", p.guess), ("true", p.true)):
            for columns, fault in self.unphysical_bodies(base, theta):
                involved = [p.parameters[j] for j in columns]
                keys = dict.fromkeys(
                    f"parameters.{parameter.group}"
                    if parameter.group
                    else f"parameters.{parameter.name}.{key}"
                    for parameter in involved
                )
                raise ExperimentError(f"{listed([*keys])}: {fault}")

    def _write_numbers(self, model: Any, theta: Array) -> dict[tuple[str, int], Array]:
        """Write every single number in place.

        Returns:
            Values that are written as a whole: (10,) coordinates of inertias by (parametrisation,
            body), and (3,) rotation vectors by (array, row).
        """
        p = self.parameters
        whole: dict[tuple[str, int], Array] = {}
        terms = {term.name: term.values for term in p.whole_terms}

        for j, target in p.targets():
            field = target.field
            number = target.scale * float(theta[j]) + target.offset
            if isinstance(field, ModelField):
                field.write(model, number)
            elif isinstance(field, InertiaField | RotationField):
                # A rotation is counted from the nominal orientation.
                is_turn = isinstance(field, RotationField)
                start = np.zeros(3) if is_turn else p.nominal[field.whole].copy()
                whole.setdefault(field.whole, start)[field.component] = number
            elif isinstance(field, TermField):
                terms[field.term.name][field.field] = number

        # A term may also depend on numbers that parameters have set just now.
        for term in p.whole_terms:
            term.write(model, terms[term.name])
        return whole

    def _edit(self, spec: Any, source: PlantModel, theta: Array) -> None:
        """Write into an MjSpec, in place, what needs a compile."""
        p = self.parameters
        for j in np.flatnonzero(p.needs_compile):
            parameter = p.parameters[j]
            if parameter.function is not None:
                try:
                    parameter.function(spec, float(theta[j]))
                except Exception as error:
                    raise ExperimentError(
                        f"parameters.{parameter.name}: its function failed: {error}"
                    ) from error

            for target in parameter.targets:
                if isinstance(target.field, SpecField):
                    number = target.scale * float(theta[j]) + target.offset
                    _write_geom(spec, source.model, target.field, target.path, number)


def _inertia_fault(model: Any, body: int, kind: str, values: Array, rounding: float) -> str:
    """Reason why this inertia is unphysical, in words; empty where it is physical.

    A body that is welded to bodies with mass may be massless.

    Args:
        model: The model with the numbers of theta.
        body: Number of the body.
        kind: Parametrisation of its inertia; empty where the model holds all of it.
        values: (10,) coordinates in the parametrisation; nothing where the model holds all of them.
        rounding: As in `unphysical_bodies`.
    """
    if kind == "logcholesky":
        return ""

    welded = model.body_weldid == model.body_weldid[body]
    welded[body] = False
    may_be_massless = model.body_weldid[body] == 0 or model.body_mass[welded].any()
    least = 0.0 if may_be_massless and kind != "barycentric" else mujoco.mjMINVAL

    mass = values[0] if kind == "barycentric" else model.body_mass[body]
    if not mass >= least:
        return f"mass {mass:g} kg; it must be > 0"

    moments = np.sort(model.body_inertia[body])
    if kind:
        moments = np.linalg.eigvalsh(INERTIA_PARAMETRISATIONS[kind].inertia(values).inertia)
    small, middle, large = moments
    wanted = "all must be > 0"
    if small >= least:
        if large - small - middle <= rounding * large:
            return ""
        wanted = (
            "the sum of the smaller two must be at least the largest (its pseudo-inertia is not "
            "positive semidefinite)"
        )
    listed = ", ".join(f"{moment:.4g}" for moment in moments)
    return f"principal moments of inertia {listed} kg m²; {wanted}"


def _write_geom(spec: Any, compiled: Any, field: SpecField, path: str, value: float) -> None:
    """Write a number of a geom into an MjSpec, in place.

    Args:
        spec: The spec (`mujoco.MjSpec`), a private copy of the caller.
        compiled: The model of this spec.
        field: The number.
        path: Its path, for the message.
        value: Its value.

    Raises:
        ExperimentError: The geom cannot be moved in the spec.
    """
    geom, found = spec.geom(field.name), compiled.geom(field.name)
    is_place = field.field == "pos"
    is_in_frame = is_place and geom.frame is not None
    if is_in_frame and geom.meshname:
        raise ExperimentError(
            f"{path!r}: a mesh inside a <frame> cannot be moved; take the geom out of the frame"
        )

    if is_in_frame or np.isfinite(geom.fromto[0]):
        # The pose is stated in the coordinates of the body instead of those of a `<frame>`, and
        # place and size as end points compile to them.
        geom.set_frame(geom.parent.add_frame())
        geom.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        geom.fromto = np.full(6, np.nan)
        geom.pos, geom.quat, geom.size = found.pos, found.quat, found.size

    numbers = np.array(getattr(geom, field.field))
    # The compiler adds the offset of a mesh to the position.
    if is_place and geom.meshname:
        value += float(numbers[field.index] - found.pos[field.index])
    # Mass and density are single numbers.
    numbers.flat[field.index] = value
    setattr(geom, field.field, numbers)
