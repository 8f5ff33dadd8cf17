"""Where derivatives do not exist: contacts, dry friction, limits and clamps make two difference steps disagree."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.identifiability import BLIND, FAINT
from mjfim.limits import clamped, forwarded
from mjfim.models import actuator_names
from mjfim.plant import SENSITIVITY_STEP
from mjfim.sensing import joint_names
from mjfim.setup import Setup
from mjfim.trajectory import Array, Sensitivity, Trajectory

LONGER = 300.0  # the second step, times the first: a change of 0.3 %
LEAST = 3.0  # the same for parameters so weak that the first step is long already
TOLERANCE = 1e-2  # relative disagreement that is told
CURVED = 6.0  # by how much the disagreement at least falls with a third of the step where a derivative exists
MINOR = 1e-3  # of the largest effect of a parameter; an output that shows less of it tells nothing


@dataclass(frozen=True)
class Roughness:
    """Disagreement of dy/dtheta by two difference steps.

    error: largest relative disagreement;  parameter: whose;  sample, time [s]: where it first shows;  causes: what acts there
    """

    error: float
    parameter: str
    sample: int
    time: float
    causes: tuple[str, ...]

    def __str__(self) -> str:
        cause = ", ".join(self.causes) or "no contact, friction or limit acts there: the motion may be chaotic"
        size = f"{100 * self.error:.2g} %" if np.isfinite(self.error) else "without bound"
        return (
            f"not smooth: derivatives by two difference steps disagree by {size} for {self.parameter}, first at sample "
            f"{self.sample} (t = {self.time:.4g} s; {cause}); sigma and design rest on derivatives that hardly exist there"
        )


def disagreement(fine: Array, coarse: Array) -> Array:
    """(N+1, p) relative disagreement of two derivatives G: (N+1, ny, p), each output's against its own largest value."""
    size = np.maximum(np.abs(fine).max(axis=0), np.abs(coarse).max(axis=0))
    size = np.maximum(size, MINOR * size.max(axis=0, initial=0.0))
    return np.asarray((np.abs(fine - coarse) / np.where(size > 0.0, size, 1.0)).max(axis=1))


def roughness(setup: Setup, theta: Array, trajectory: Trajectory, fine: Sensitivity | None = None) -> Roughness | None:
    """The worst disagreement along a trajectory, or None where it is below `TOLERANCE`. fine: by the first step, if known"""
    plant = setup.plant
    fine = plant.sensitivity(theta, trajectory) if fine is None else fine
    longer = np.maximum(LONGER * setup.parameters.step / plant.span, LEAST)
    coarse = plant.sensitivity(theta, trajectory, longer * SENSITIVITY_STEP)
    names = setup.parameters.names
    if fine is None or coarse is None:
        causes = tuple(_active(setup.model_at(theta), trajectory, range(trajectory.samples)))
        return Roughness(np.inf, ", ".join(names), 0, 0.0, causes)
    G = setup.noise.whiten(fine.G)
    kept = np.flatnonzero(visible_columns(setup, G))
    if not len(kept):
        return None
    error = disagreement(G, setup.noise.whiten(coarse.G))[:, kept]
    worst = int(np.argmax(error.max(axis=0)))
    if not error[:, worst].max() > TOLERANCE:
        return None
    between = plant.sensitivity(theta, trajectory, np.maximum(longer / 3.0, 1.5) * SENSITIVITY_STEP)
    if between is not None:
        less = disagreement(G, setup.noise.whiten(between.G))[:, kept]
        if (less.max(axis=0) * CURVED <= error.max(axis=0)).all():
            return None  # the error of central differences falls ninefold: strongly curved, but smooth
    first = int(np.argmax(error[:, worst] > TOLERANCE))
    near = range(max(first - 2, 0), min(first + 1, trajectory.samples))
    causes = tuple(_active(setup.model_at(theta), trajectory, near))
    return Roughness(float(error[:, worst].max()), names[kept[worst]], first, float(trajectory.t[first]), causes)


def visible_columns(setup: Setup, G: Array) -> np.ndarray:
    """(p,) True where a parameter has an effect that stands out of round-off. G: (N+1, ny, p), whitened"""
    length = np.linalg.norm(G, axis=(0, 1)) * setup.parameters.step
    return np.asarray((length > BLIND) & (length > FAINT * length.max(initial=0.0)))


def first_active(model: Any, trajectory: Trajectory) -> tuple[int, tuple[str, ...]] | None:
    """First sample at which a contact, friction, limit or clamp acts, and what; None where none ever does."""
    for k, data in forwarded(model, trajectory, range(trajectory.samples)):
        causes = (*sorted(set(_at(model, data))), *_ranges(model, clamped(model, data)))
        if causes:
            return k, causes
    return None


def _active(model: Any, trajectory: Trajectory, samples: range) -> Iterator[str]:
    """Contacts, frictions, limits and clamps that act at these samples, each once."""
    told, hit = set[str](), set[int]()
    for _, data in forwarded(model, trajectory, samples):
        told.update(_at(model, data))
        hit.update(clamped(model, data))
    yield from sorted(told)
    yield from _ranges(model, hit)


def _ranges(model: Any, actuators: Iterable[int]) -> Iterator[str]:
    names = actuator_names(model)
    yield from (f"force range of {names[i]}" for i in sorted(actuators))


def _at(model: Any, data: Any) -> Iterator[str]:
    for contact in data.contact[: data.ncon]:
        names = (mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, g) or f"geom{g}" for g in contact.geom)
        yield f"contact {' - '.join(names)}"
    joints = joint_names(model)
    for kind, ident in zip(data.efc_type, data.efc_id, strict=True):
        if kind == int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF):
            yield f"dry friction of {joints[model.dof_jntid[ident]]}"
        elif kind == int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT):
            yield f"limit of {joints[ident]}"
        elif kind in (
            int(mujoco.mjtConstraint.mjCNSTR_FRICTION_TENDON),
            int(mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON),
        ):
            yield f"friction or limit of tendon {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_TENDON, ident) or ident}"
