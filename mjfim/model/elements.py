"""Elements of a compiled MuJoCo model by kind and name."""

from __future__ import annotations

from typing import Any

import mujoco

# MuJoCo's object type of every kind of element that a parameter path can name.
OBJECT_TYPES = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "pair": mujoco.mjtObj.mjOBJ_PAIR,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "sensor": mujoco.mjtObj.mjOBJ_SENSOR,
}

# Field of MjModel that counts the elements of a kind, where it is not called `n<kind>`.
COUNT_FIELDS = {"joint": "njnt", "actuator": "nactuator"}


def element_count(model: Any, kind: str) -> int:
    """Number of elements of a kind, with and without a name.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        kind: A key of `OBJECT_TYPES`.
    """
    return int(getattr(model, COUNT_FIELDS.get(kind, f"n{kind}")))


def names_of(model: Any, kind: str) -> list[str]:
    """Names of all elements of a kind that have one, in the order of the model.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        kind: A key of `OBJECT_TYPES`.
    """
    names = [element_name(model, kind, i) for i in range(element_count(model, kind))]
    return [name for name in names if name]


def unnamed_count(model: Any, kind: str) -> int:
    """Number of elements of a kind that have no name.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        kind: A key of `OBJECT_TYPES`.
    """
    return element_count(model, kind) - len(names_of(model, kind))


def unique_names(model: Any, kind: str) -> tuple[str, ...]:
    """Unique names of all elements of a kind.

    An element without a name is called `<kind><number>`; underscores are appended where another
    element has that name.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        kind: A key of `OBJECT_TYPES`.
    """
    names = [element_name(model, kind, i) for i in range(element_count(model, kind))]
    taken = set(names)

    for i, given in enumerate(names):
        if not given:
            name = f"{kind}{i}"
            while name in taken:
                name += "_"
            names[i] = name

    return tuple(names)


def geom_labels(model: Any) -> tuple[str, ...]:
    """Labels of all geoms: the name of a geom, or `<body> geom <number>` where it has none.

    Args:
        model: The compiled model (`mujoco.MjModel`).
    """
    bodies = unique_names(model, "body")
    return tuple(
        element_name(model, "geom", geom) or f"{bodies[body]} geom {geom}"
        for geom, body in enumerate(model.geom_bodyid.tolist())
    )


def identifier(model: Any, kind: str, name: str) -> int:
    """Number of the element of a kind that has a name.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        kind: A key of `OBJECT_TYPES`.
        name: Name of the element.

    Returns:
        The number; -1 where no element has the name.
    """
    return int(mujoco.mj_name2id(model, OBJECT_TYPES[kind], name))


def element_name(model: Any, kind: str, number: int) -> str:
    """Name of an element in the MJCF.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        kind: A key of `OBJECT_TYPES`.
        number: Number of the element.

    Returns:
        The name; empty where the element has none.
    """
    return mujoco.mj_id2name(model, OBJECT_TYPES[kind], number) or ""


def is_rk4(model: Any) -> bool:
    """Whether a model is integrated with RK4, which computes forces at four stages of a step.

    Args:
        model: The compiled model (`mujoco.MjModel`).
    """
    return int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4)
