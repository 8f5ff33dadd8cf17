"""The library of terms: all kinds, and the terms of an experiment resolved against its model."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from mjfim.errors import ExperimentError, unknown
from mjfim.model.terms import base, drives, elasticity, friction, load_friction
from mjfim.model.terms.term import FieldDescription, Term, TermTable

# All kinds of terms, by the name that the experiment file gives them.
KINDS: dict[str, type[Term]] = {
    kind.kind: kind
    for module in (friction, load_friction, drives, elasticity, base)
    for kind in vars(module).values()
    if isinstance(kind, type) and issubclass(kind, Term) and "kind" in vars(kind)
}


def resolve_terms(
    tables: Iterable[tuple[str, TermTable]], model: Any, period: float
) -> tuple[Term, ...]:
    """Resolve the terms of an experiment.

    Args:
        tables: Kind and table of each term.
        model: The stated model without terms (`mujoco.MjModel`).
        period: Sample period of the experiment [s].

    Raises:
        ExperimentError: A table does not fit the model; the message names its key.
    """
    terms = []
    for kind, table in tables:
        if kind not in KINDS:
            raise ExperimentError(f"terms.{table.name}.kind: {unknown('kind', kind, list(KINDS))}")
        try:
            terms.append(KINDS[kind].of(table, model, period))
        except ExperimentError as error:
            raise ExperimentError(f"terms.{table.name}: {error}") from None
    return tuple(terms)


# ---- catalogue

TEDALDI_2014 = (
    "D. Tedaldi, A. Pretto and E. Menegatti, A robust and easy to implement method for IMU "
    "calibration without external equipments, IEEE International Conference on Robotics and "
    "Automation, 2014"
)
LJUNG_1999 = (
    "L. Ljung, System Identification: Theory for the User, 2nd edition, Prentice Hall, 1999"
)
BATCHELOR_1967 = "G. K. Batchelor, An Introduction to Fluid Dynamics, Cambridge University Press"


@dataclass(frozen=True, kw_only=True)
class CatalogueEntry:
    """A physical term in words.

    Attributes:
        name: Kind of a term of the library; a name in words of a number of the MJCF.
        description: One sentence about the physics.
        equation: The force, torque or reading.
        elements: MuJoCo's elements of which it consists.
        acts_on: Key of the table that names the element on which it acts; empty without one.
        fields: Fields of a term of the library.
        paths: Parameter paths of numbers of the MJCF.
        sources: Publications that describe it.
    """

    name: str
    description: str
    equation: str
    elements: str
    acts_on: str = ""
    fields: tuple[FieldDescription, ...] = ()
    paths: tuple[str, ...] = ()
    sources: tuple[str, ...]


# Terms that are numbers of the MJCF, so that they need no table.
NUMBERS = (
    CatalogueEntry(
        name="dry friction",
        description="Coulomb friction of a joint or a tendon, which sticks at rest.",
        equation="F = -f sgn(v)",
        elements="frictionloss",
        paths=("joint/<name>:frictionloss", "tendon/<name>:frictionloss"),
        sources=(friction.OLSSON_1998,),
    ),
    CatalogueEntry(
        name="viscous friction",
        description="Friction of a lubricant, and the back-EMF of a motor with short circuit.",
        equation="F = -b0 v",
        elements="damping",
        paths=("joint/<name>:damping", "tendon/<name>:damping"),
        sources=(friction.ARMSTRONG_1994,),
    ),
    CatalogueEntry(
        name="drag",
        description="Quadratic drag in air or oil, and a viscosity that changes with the speed.",
        equation="F = -(b0 v + b1 v |v| + b2 v³)",
        elements="damping of a joint with two or three numbers",
        paths=("joint/<name>:damping[1]", "joint/<name>:damping[2]"),
        sources=(BATCHELOR_1967, friction.ARMSTRONG_1994),
    ),
    CatalogueEntry(
        name="rotor inertia",
        description="Inertia of a rotor behind a gear, reflected to the joint.",
        equation="F = -J q̈",
        elements="armature",
        paths=("joint/<name>:armature", "tendon/<name>:armature"),
        sources=(elasticity.SPONG_1987,),
    ),
    CatalogueEntry(
        name="spring",
        description="A spring of a joint, such as that of a cable or a balance.",
        equation="F = -(k0 x + k1 x |x| + k2 x³), x = q - springref",
        elements="stiffness, springref",
        paths=("joint/<name>:stiffness", "joint/<name>:springref", "joint/<name>:stiffness[1]"),
        sources=(LJUNG_1999,),
    ),
    CatalogueEntry(
        name="torque constant",
        description="Torque of a direct drive per unit of its control.",
        equation="τ = gain · control",
        elements="gainprm of a motor",
        paths=("actuator/<name>:gainprm[0]",),
        sources=(drives.KRAUSE_2013,),
    ),
    CatalogueEntry(
        name="gravity",
        description="Direction and size of gravity; `tilt` turns it and keeps its size.",
        equation="F = m g",
        elements="option/gravity",
        paths=("option:gravity[i]",),
        sources=(base.SWEVERS_2007,),
    ),
    CatalogueEntry(
        name="air or water",
        description="Forces of a fluid on all bodies, by their inertia boxes.",
        equation="MuJoCo's fluid forces, linear in viscosity, quadratic with density",
        elements="option/density, option/viscosity, option/wind",
        paths=("option:density", "option:viscosity", "option:wind[i]"),
        sources=(BATCHELOR_1967,),
    ),
    CatalogueEntry(
        name="misalignment of a sensor",
        description="A sensor whose axes are turned against the site that the MJCF states.",
        equation="y = R(rot) y of the site",
        elements="site orientation",
        paths=("site/<name>:rot[i]",),
        sources=(TEDALDI_2014,),
    ),
    CatalogueEntry(
        name="scale of a sensor",
        description="A reading that is too large by a constant share s.",
        equation="y = (1 + s) h + b",
        elements="not part of an MJCF",
        paths=("output/<name>:scale",),
        sources=(TEDALDI_2014,),
    ),
    CatalogueEntry(
        name="bias of a sensor",
        description="A reading with a constant offset b.",
        equation="y = (1 + s) h + b",
        elements="not part of an MJCF",
        paths=("output/<name>:bias",),
        sources=(TEDALDI_2014,),
    ),
    CatalogueEntry(
        name="delay",
        description="Readings that are late against the controls.",
        equation="y(t) = h(t - d)",
        elements="not part of an MJCF",
        paths=("output:delay",),
        sources=(LJUNG_1999,),
    ),
)

# Terms of the library, each of which is added by a table `[terms.<name>]`.
TERMS = tuple(
    CatalogueEntry(
        name=kind.kind,
        description=kind.description,
        equation=kind.equation,
        elements=kind.elements,
        acts_on=kind.acts_on,
        fields=kind.fields,
        sources=kind.sources,
    )
    for kind in KINDS.values()
)
