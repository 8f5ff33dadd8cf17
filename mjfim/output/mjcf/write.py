"""The user's MJCF with identified values.

A file is written only if it compiles to the identified model.
"""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import scipy
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.errors import ModelError, first_ones, listed
from mjfim.experiment.system import System
from mjfim.files import replacing
from mjfim.model.control_laws import remove_numbers
from mjfim.model.loading import compile_spec, load_written_model
from mjfim.model.parameters import ParameterSet
from mjfim.model.paths import MODEL_ARRAYS, resolve
from mjfim.model.spec_writer import state_derived_values, write_element
from mjfim.model.variants import unconstrained
from mjfim.output.mjcf.asset_paths import attach_files, relocate_assets
from mjfim.output.mjcf.document import MjcfDocument
from mjfim.output.mjcf.edited_files import EditedFiles
from mjfim.output.mjcf.edits import ParameterEdits
from mjfim.output.mjcf.terms import with_terms

# Prefixes of the arrays of MjModel that determine the motion.
COMPARED = (
    "body_",
    "jnt_",
    "dof_",
    "qpos",
    "actuator_",
    "tendon_",
    "site_pos",
    "site_quat",
    "geom_pos",
    "geom_quat",
    "geom_size",
    "geom_friction",
    "geom_solref",
    "pair_friction",
    "pair_solref",
)

# Prefixes of arrays that COMPARED covers but that only speed up the computation, or are compared as
# matrices.
NOT_DYNAMICS = (
    "body_bvh",
    "body_simple",
    "body_sameframe",
    "body_margin",
    "body_inertia",
    "body_iquat",
    "dof_simplenum",
)

# Difference below which numbers of two models count as equal: share of the number itself, and share
# of the largest finite number of its array, which the rounding of MuJoCo's compiler is relative to.
RELATIVE_TOLERANCE = 1e-9
ROUNDING = 1e-12

# Constraint weights of bodies, which MuJoCo averages differently for 'simple' bodies.
INVERSE_WEIGHT = "body_invweight0"

# Longest list of objects in a remark on a written model [characters].
REMARK_TEXT = 120


@dataclass(frozen=True, kw_only=True)
class WrittenUrdfs:
    """URDFs with identified values, which an MJCF attaches in place of the user's.

    Attributes:
        files: The new URDFs by the resolved paths of the user's.
        held: Names of the parameters whose values they hold.
        remarks: Sentences about URDFs that could not be written, and about values that they cannot
            hold.
    """

    files: dict[Path, Path] = field(default_factory=dict)
    held: frozenset[str] = frozenset()
    remarks: tuple[str, ...] = ()


def write_identified(
    path: Path, system: System, theta: Array, urdfs: WrittenUrdfs | None = None
) -> str | None:
    """Write the user's MJCF with parameter values.

    In the user's text the numbers are replaced, with all their digits. Included files whose text
    changes are written beside the main file, under the names of `copies_of_included_files`.

    Where the text cannot express the values, MuJoCo prints the model (six significant digits).

    Args:
        path: File that is written; its folder may differ from that of the model.
        system: The experiment with its model.
        theta: (p,) parameter values.
        urdfs: URDFs with these values that the MJCF attaches; default: none.

    Returns:
        A sentence about everything else that changes, None if nothing does.

    Raises:
        ModelError: No MJCF expresses the values.
    """
    wanted = system.model_at(theta, at_keyframe=False)

    remarks = []
    try:
        stated = _write_edited(path, system, theta, wanted, urdfs or WrittenUrdfs())
    except ModelError as error:
        _write_printed(path, system, theta, wanted)
        remarks.append(
            f"it is printed by MuJoCo, with six significant digits and without comments: {error}"
        )
    else:
        if stated:
            remarks.append(
                "it also states numbers that MuJoCo would otherwise derive from the identified "
                f"values: {first_ones(stated, longest=REMARK_TEXT)}"
            )

    found = load_written_model(path)
    reweighted = _reweighted_bodies(found, wanted, same_class=False)
    if reweighted and not unconstrained(found):
        names = first_ones([*map(repr, reweighted)], longest=REMARK_TEXT)
        remarks.append(
            f"contacts and other constraints of {names} are slightly "
            "softer or stiffer than in the fit, where MuJoCo could not treat these bodies as "
            "'simple' (body_invweight0)"
        )
    if system.laws is not None:
        names = first_ones([law.actuator for law in system.laws.laws], longest=REMARK_TEXT)
        remarks.append(
            f"it holds the model without the control laws of {names}, because MJCF has no laws "
            "with a rate; estimate.json holds their numbers"
        )
    return f"{path.name}: {'; '.join(remarks)}" if remarks else None


def _write_edited(
    path: Path, system: System, theta: Array, wanted: Any, urdfs: WrittenUrdfs
) -> list[str]:
    """Write the edited text; return the objects whose derived numbers had to be stated.

    Raises ModelError, with a clause that gives the reason, where the text cannot express the
    values.
    """
    source = system.model_path.resolve()
    document = with_terms(MjcfDocument(source.read_bytes(), source), system.source)
    relocate_assets(document, system.source.spec, source.parent, path.resolve().parent)
    attach_files(document, source.parent, path.resolve().parent, urdfs.files)

    # The URDFs hold the values of their own elements.
    edits = ParameterEdits(document, system.source.spec, system.model, wanted)
    names = np.array([name not in urdfs.held for name in system.parameters.names], dtype=bool)
    others = tuple(p for p in system.parameters.parameters if p.name not in urdfs.held)
    edits.write_parameters(replace(system.parameters, parameters=others), theta[names])

    stated: list[str] = []
    with ExitStack() as stack:
        files = EditedFiles(document, system.source.spec, path, stack)
        found = files.compiled()
        different = _differences(found, wanted)
        if different:
            stated = edits.write_derived(found)
            different = _differences(files.compiled(), wanted)

        if different:
            raise ModelError(
                f"with the identified values the text compiles to a different {listed(different)}"
            )
        files.finish()
    return stated


def _write_printed(path: Path, system: System, theta: Array, wanted: Any) -> None:
    """Write the model as MuJoCo prints it; refuse a print that compiles to another model."""
    # If the plain values are refused or give another model, derived numbers are stated as well.
    for states_derived in (False, True):
        spec = system.source.spec.copy()
        remove_numbers(spec)
        if states_derived:
            state_derived_values(spec, system.model)

        try:
            write_spec(spec, system.model, wanted, system.parameters, theta)
            compiled = compile_spec(spec, system.model_path)
        except (ValueError, ModelError) as error:
            if states_derived:
                raise ModelError(f"{path}: MuJoCo refuses the identified values: {error}") from None
            continue

        if same_dynamics(compiled, wanted):
            _save(path, spec, system.model_path)
            return

    raise ModelError(
        f"{path}: not written: with the identified values the MJCF compiles to another model than "
        "the identified one"
    )


def _save(path: Path, spec: Any, model_path: Path) -> None:
    """Write an MjSpec to a file that loads from its folder."""
    source, target = model_path.resolve().parent, path.resolve().parent
    for attribute in ("meshdir", "texturedir"):
        folder = source / getattr(spec, attribute)
        setattr(spec, attribute, os.path.relpath(folder, target))
    spec.modelfiledir = str(target)

    with replacing(path) as temporary:
        temporary.write_text(spec.to_xml(), encoding="utf-8")
        load_written_model(temporary)


def same_dynamics(a: Any, b: Any) -> bool:
    """Compare everything that determines the motion of two models.

    Args:
        a: A compiled MuJoCo model.
        b: Another one.

    Returns:
        Whether they agree.
    """
    return not _differences(a, b)


def _differences(a: Any, b: Any) -> list[str]:
    """Return the arrays that determine the motion and differ between two models."""
    names = [n for n in dir(a) if n.startswith(COMPARED) and not n.startswith(NOT_DYNAMICS)]
    found = [name for name in names if not _equal(getattr(a, name), getattr(b, name))]
    found += [n for n in MODEL_ARRAYS["option"] if not _equal(getattr(a.opt, n), getattr(b.opt, n))]

    # The weights of a body that is 'simple' in one model only are averaged differently.
    if found == [INVERSE_WEIGHT] and not _reweighted_bodies(a, b, same_class=True):
        found = []

    # Principal axes may be named in any order: the inertias are compared as matrices.
    if a.nbody != b.nbody:
        return [*found, "body_inertia"]
    traces = np.sum(b.body_inertia, axis=1)[:, None, None]
    difference = np.abs(_inertia_matrices(a) - _inertia_matrices(b))
    if (difference > RELATIVE_TOLERANCE * traces).any():
        return [*found, "body_inertia"]
    return found


def _equal(x: Any, y: Any) -> bool:
    """Return whether two arrays have the same shape and nearly the same numbers."""
    x, y = np.asarray(x), np.asarray(y)
    if np.array_equal(x, y):
        return True
    return x.shape == y.shape and bool(_close(x, y).all())


def _close(x: Array, y: Array) -> NDArray[np.bool_]:
    """Return which numbers of two arrays of the same shape are nearly the same, in any unit."""
    finite = np.abs(y[np.isfinite(y)])
    rounding = ROUNDING * float(finite.max(initial=0.0))
    return np.isclose(x, y, rtol=RELATIVE_TOLERANCE, atol=rounding)


def _reweighted_bodies(a: Any, b: Any, same_class: bool) -> list[str]:
    """Return the bodies whose constraint weight differs between two models.

    In a fit the bodies that a parameter changes are never 'simple', and MuJoCo averages the weight
    of a simple body differently. With `same_class`, only bodies count that are 'simple' in both
    models or in neither; without it, only bodies that are 'simple' in one of them.
    """
    close = _close(a.body_invweight0, b.body_invweight0)
    in_same_class = (a.body_simple > 0) == (b.body_simple > 0)
    bodies = np.flatnonzero(~close.all(axis=1) & (in_same_class == same_class))

    kind = mujoco.mjtObj.mjOBJ_BODY
    return [mujoco.mj_id2name(a, kind, int(i)) or f"body{i}" for i in bodies]


def _inertia_matrices(model: Any) -> Array:
    """Return the (nbody, 3, 3) inertias in the axes of their bodies [kg m²]."""
    R = scipy.spatial.transform.Rotation.from_quat(model.body_iquat, scalar_first=True).as_matrix()
    return np.asarray(np.einsum("bij,bj,bkj->bik", R, model.body_inertia, R))


def write_spec(
    spec: Any, compiled: Any, wanted: Any, parameters: ParameterSet, theta: Array
) -> None:
    """Write parameter values into an MjSpec.

    Args:
        spec: The MjSpec; it is changed.
        compiled: Model that it compiles to before the change.
        wanted: Model at the values.
        parameters: The parameters.
        theta: (p,) values.
    """
    for parameter, value in zip(parameters.parameters, theta, strict=True):
        if parameter.function is not None:
            parameter.function(spec, float(value))

        for target in parameter.targets:
            written = target.scale * float(value) + target.offset
            for path in target.plain_paths:
                if target.term is not None:
                    written = resolve(wanted, path).read(wanted)
                write_element(spec, compiled, wanted, path, written)
