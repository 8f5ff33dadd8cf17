"""Simpler models: parameters that recordings hardly determine are pooled or held at their guess.

One number for the friction of all joints, for example, may predict a robot as well as one number
for each of them, and is known much better.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from mjfim.experiment.schema import Experiment
from mjfim.model.parameters import Parameter, ParameterSet
from mjfim.model.paths import ParameterPath
from mjfim.records.terms import PooledParameter

# Smallest number of parameters that are pooled.
MIN_MEMBERS = 2


def possible_pools(parameters: ParameterSet, names: Collection[str]) -> list[PooledParameter]:
    """Groups of parameters that stand for the same field of different elements.

    Args:
        parameters: All parameters.
        names: Names of the parameters that may be pooled.

    Returns:
        A pool for each group of two or more parameters with one target each and common bounds.
    """
    groups: dict[tuple[str, str, int | None, str], list[Parameter]] = {}
    for parameter in parameters.parameters:
        if parameter.name not in names or not _is_plain(parameter):
            continue
        path = ParameterPath.parse(parameter.targets[0].path)
        key = (path.kind, path.field, path.index, parameter.unit)
        groups.setdefault(key, []).append(parameter)

    taken = set(parameters.names)
    pools = []
    for (kind, field, _, _), members in groups.items():
        pool = None
        if len(members) >= MIN_MEMBERS:
            pool = _pool(f"{kind}_{field}", members, taken)
        if pool is not None:
            taken.add(pool.name)
            pools.append(pool)
    return pools


def _is_plain(parameter: Parameter) -> bool:
    """Whether a parameter sets one number of an element, and nothing else is stated about it."""
    if len(parameter.targets) != 1 or parameter.function is not None or parameter.group:
        return False
    target = parameter.targets[0]
    is_number = target.scale == 1.0 and target.offset == 0.0
    return is_number and parameter.prior is None and not parameter.per_recording


def _pool(
    stem: str, members: Sequence[Parameter], taken: Collection[str]
) -> PooledParameter | None:
    """One parameter in place of several; None where no value lies within the bounds of all.

    Where all guesses have one sign and differ, it is a factor on the guesses, because elements of
    different size have different values.
    """
    name = stem
    number = 2
    while name in taken:
        name = f"{stem}_{number}"
        number += 1

    guesses = np.array([member.guess for member in members])
    is_factor = bool((guesses > 0.0).all() or (guesses < 0.0).all()) and np.ptp(guesses) > 0.0
    scales = guesses if is_factor else np.ones(len(members))
    guess = 1.0 if is_factor else float(guesses.mean())

    # The pool keeps the bounds of all members.
    low = max(min(bound / s for bound in m.bounds) for m, s in zip(members, scales, strict=True))
    high = min(max(bound / s for bound in m.bounds) for m, s in zip(members, scales, strict=True))
    if not low < high:
        return None
    guess = float(np.clip(guess, low, high))
    sizes = [m.scale / abs(s) for m, s in zip(members, scales, strict=True)]
    return PooledParameter(
        name=name,
        members=tuple(member.name for member in members),
        paths=tuple(member.targets[0].path for member in members),
        scales=tuple(float(scale) for scale in scales),
        guess=guess,
        unit="" if is_factor else members[0].unit,
        scale=max(1.0, *sizes) if is_factor else max(sizes),
        bounds=(float(low), float(high)),
    )


def simplified_experiment(
    experiment: Experiment, pooled: Iterable[PooledParameter], held: Collection[str]
) -> Experiment:
    """An experiment with pooled and held parameters.

    Args:
        experiment: The experiment.
        pooled: Pools, which take the places of their members.
        held: Names of parameters that keep their guess.

    Returns:
        The experiment, checked again.
    """
    pools = list(pooled)
    if not pools and not held:
        return experiment

    values = experiment.model_dump(exclude_unset=True)
    members = {name for pool in pools for name in pool.members}
    tables = {name: table for name, table in values["parameters"].items() if name not in members}
    values["parameters"] = {**tables, **{pool.name: pool.table for pool in pools}}
    if held:
        fit = values.get("fit", {})
        values["fit"] = {**fit, "hold": (*fit.get("hold", ()), *sorted(held))}
    return experiment.restated(values)
