"""The pages of a design and of a check."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from mjfim.arrays import NORMAL_95, POORLY_KNOWN_SHARE, UNDETERMINED_SHARE, Array, finite_or_nan
from mjfim.errors import first_ones, listed
from mjfim.output.page import (
    Emphasis,
    Listing,
    Page,
    Part,
    Plot,
    Row,
    Table,
    Text,
    as_sentence,
    capitalised,
    named,
    number,
    numbers,
    parameter_names,
    tabulated,
    warned,
)
from mjfim.output.pages.worth import worth_parts
from mjfim.output.words import (
    BEST_CASE,
    NOT_ALONE,
    format_percent,
    improvement,
    relative,
    sigma_remark,
    when_learnt,
)
from mjfim.records.base import Level, Verdict
from mjfim.records.check import (
    Check,
    ParameterCheck,
    ParameterGroup,
    combination_terms,
    unknown_groups,
)
from mjfim.records.design import (
    TIE_TOLERANCE,
    Design,
    DesignComparison,
    ScaledStart,
    is_playable,
    keeps_limits,
)
from mjfim.records.rehearsal import REST_SHARE, Fan, LimitRange, Rehearsal, Valley

# Ratio of two standard deviations above which one of them counts as smaller.
RELEVANT_RATIO = 1.05

# Ratio of the largest σ of a start to that of its design below which a verdict states the gain.
SMALL_GAIN = 1.1

# Largest number of limits that the initial control violates and that a page lists.
MAX_VIOLATIONS = 4

# Numbers of the eigenvalues that a table shows where there are more than these, largest first.
SHOWN_EIGENVALUES = (0, 1, 2, -2, -1)

# Longest text of the dangers of a motion in its verdict [characters].
MAX_FAULTS_TEXT = 320

# Digits as subscripts.
SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")

# Smallest divisor of the improvement of an eigenvalue; avoids a division by zero. Above the largest
# improvement, a control determines next to nothing: a σ is 100 times larger.
TINY, LARGEST_IMPROVEMENT = 1e-300, 1e4

# Steps that follow a motion which can be played.
PLAY = (
    "Export the motion for the robot: `mjfim export DESIGN_FOLDER --to player -o "
    "DESIGN_FOLDER/player.py`.",
    "Record it, then estimate: `mjfim identify EXPERIMENT RECORDING -o FOLDER`.",
)


def design_page(design: Design) -> Page:
    """Describe predicted standard deviations before and after a design, and how it ended."""
    search: list[Part] = [_eigenvalue_table(design), Plot("convergence", detail=True)]
    if len(design.starts) > 1:
        search.append(_start_table(design))
    before, after = _least_eigenvalues(design)
    reserve = listed([f"{100 * share:.2g} % of {kind}" for kind, share in design.reserve.items()])
    return Page(
        kind="Design of an experiment",
        verdict=_verdict(design),
        next_steps=tuple(_next_steps(design)),
        warnings=design.warnings,
        facts={
            "duration": f"{_seconds(design):.4g} s",
            "λ_min": f"{number(before)} → {number(after)}",
            "iterations": str(design.iterations),
            "time of the search": f"{design.seconds:.3g} s",
            **({"reserve": reserve} if reserve else {}),
        },
        sections={
            "Accuracy": _accuracy_parts(design),
            "Two robots": _valley_parts(design.valley),
            "Rehearsal": _rehearsal_parts(design.rehearsal),
            "Motion": [Plot("trajectories")],
            "Limits": _limit_parts(design),
            "Optimisation": search,
            "What would help": worth_parts(design.worth, detail=True),
        },
    )


def _seconds(design: Design) -> float:
    """Duration of the motion [s]."""
    return float(design.trajectory.t[-1] - design.trajectory.t[0])


def _least_eigenvalues(design: Design) -> list[float]:
    """The smallest eigenvalue of the information before and after the search."""
    return [float(each.eigenvalues[0]) for each in (design.initial, design.final)]


# ---- verdict


def _verdict(design: Design) -> Verdict:
    violated = [kind.replace("_", " ") for kind, margin in design.limits.items() if margin < 0.0]
    if violated:
        text = f"Do not play this motion: it violates limits ({first_ones(violated)})."
        return Verdict(text, Level.BAD)
    rehearsal, separable = design.rehearsal, _is_separable(design)
    ok = is_playable(design) and separable
    if rehearsal is None:
        text = f"The design was {design.outcome}. It was not rehearsed on robots."
        return Verdict(text, Level.DOUBTFUL, ok)
    if not rehearsal.is_safe:
        return _danger(rehearsal)
    seen = " ".join(_observed(rehearsal))
    if design.is_start and not design.status.success:
        return Verdict(f"The design is no better than its start. {seen}", Level.DOUBTFUL)
    if not separable:
        text = (
            "The design is made for combinations of parameters, because no control separates these "
            f"parameters: {first_ones(design.combinations, '; ')}. {seen}"
        )
        return Verdict(text, Level.DOUBTFUL)
    reservation = _reservation(design) or _reservation_of_robots(rehearsal)
    poorly = _with_interval(design, POORLY_KNOWN_SHARE)
    if poorly and not reservation:
        reservation = f"it hardly determines {_with_widest(design, poorly)}"
    if not (ok or reservation):
        reservation = "the search was interrupted"
    if reservation:
        played = f"This motion can be played{_at_end(rehearsal)}"
        text = f"{played}, but {reservation}. {_gain(design)}{seen}"
        return Verdict(text, Level.DOUBTFUL, ok)
    text = f"Ready to play{_at_end(rehearsal)}: {_accuracy(design)}. {_gain(design)}{seen}"
    return Verdict(text, Level.GOOD, ok)


def _gain(design: Design) -> str:
    """Say that a design gains little over its start; empty where it gains more."""
    if design.is_start:
        return "It is no better than its start. "
    sizes = np.where(design.sizes > 0.0, design.sizes, np.inf)
    first, last = (
        float(np.max((each.std / sizes)[list(design.wanted)], initial=0.0))
        for each in (design.initial, design.final)
    )
    if not (_is_allowed(design) and 0.0 < first < SMALL_GAIN * last < np.inf):
        return ""
    share = format_percent(abs(1.0 - last / first))
    place = f"only {share} below" if last < first else f"{share} above"
    return f"Its largest σ is {place} that of its start. "


def _is_allowed(design: Design) -> bool:
    """Whether the start keeps all limits with the reserve."""
    return design.scaled_start is None and not design.initial_violations


def _is_separable(design: Design) -> bool:
    """Whether every wanted parameter is identifiable alone, from data or with its prior."""
    return bool(np.isfinite(design.final.std[list(design.wanted)]).all())


def _danger(rehearsal: Rehearsal) -> Verdict:
    """Say what happens to robots that must not happen, the worst first."""
    return Verdict(f"Do not play this motion. {_faults_of(rehearsal)}.", Level.BAD)


def _faults_of(rehearsal: Rehearsal) -> str:
    """What happens to robots that must not happen, the worst first."""
    faults = first_ones(list(_faults(rehearsal)), "; ", MAX_FAULTS_TEXT)
    return f"Of {_robots(rehearsal)}, {faults}" if rehearsal.robots else capitalised(faults)


def _robots(rehearsal: Rehearsal) -> str:
    return f"{rehearsal.robots} robots whose parameters are up to {100 * rehearsal.wrong:g} % off"


def _that(count: int, verb: str) -> str:
    """Say how many robots do something; the model does it where none of them does."""
    of_one = f"{verb}{'es' if verb.endswith('s') else 's'}"
    return f"{count} {verb if count > 1 else of_one}" if count else f"the model {of_one}"


def _faults(rehearsal: Rehearsal) -> Iterator[str]:
    if rehearsal.diverged:
        yield f"{_that(rehearsal.diverged, 'diverge')} in the simulation"
    if rehearsal.passes_floor.any():
        passing, deepest = _that(rehearsal.below_floor, "pass"), -np.nanmin(rehearsal.lowest)
        yield f"{passing} through {_floor(rehearsal)}, by up to {deepest:.3g} m"
    yield from _left_limits(rehearsal)
    for name, count in rehearsal.unbraked.items():
        yield f"{_that(count, 'end')} too fast to be braked before the limit of {name}"


def _left_limits(rehearsal: Rehearsal) -> Iterator[str]:
    """Say which limits robots leave, the least kept first."""
    worst = finite_or_nan(rehearsal.margins)
    broken = np.flatnonzero(~rehearsal.kept.all(axis=0))
    order = np.lexsort((rehearsal.kept[:, broken].sum(axis=0), rehearsal.is_clamped[broken]))
    for i in broken[order].tolist():
        limit, count = rehearsal.limits[i], int((~rehearsal.kept[1:, i]).sum())
        excess = -np.nanmin(worst[:, i]) * limit.scale
        manner = f"by up to {excess:.3g} {limit.unit}".rstrip() if excess > 0.0 else "to its clamp"
        yield f"{_that(count, 'leave')} the limit on {_kind(limit)} of {limit.name}, {manner}"


def _floor(rehearsal: Rehearsal) -> str:
    """Name the floor, with the height of one that is assumed."""
    if not np.isfinite(rehearsal.floor):
        return "the origin of the world"
    height = f"{rehearsal.floor:.3g} m"
    return "the floor" if rehearsal.has_floor else f"the floor that is assumed at {height}"


def _kind(limit: LimitRange) -> str:
    return limit.kind.replace("_", " ")


def _observed(rehearsal: Rehearsal) -> Iterator[str]:
    """Say how sure σ is, what robots do in a motion that is safe, and what nothing limits."""
    if str(rehearsal.steps):
        yield as_sentence(str(rehearsal.steps))
    if not rehearsal.limits:
        others = f"; {_robots(rehearsal)} were tried" if rehearsal.robots else ""
        yield f"No limits were stated{others}."
    elif rehearsal.robots:
        yield f"{rehearsal.all_kept} of {_robots(rehearsal)} keep all limits."
    else:
        yield "The model keeps all limits."
    lengths = [unit.removesuffix("/s") for unit in rehearsal.units]
    travel = _unlimited("position", rehearsal, rehearsal.unplaced, rehearsal.travel, lengths)
    if travel:
        yield f"{travel} from the start."
    speeds = _unlimited("speed", rehearsal, rehearsal.unlimited, rehearsal.speed, rehearsal.units)
    if speeds:
        yield f"{speeds}."
    moving = _moving_at_end(rehearsal)
    yield f"It ends in motion: {first_ones(moving)}." if moving else "It ends at rest."


def _at_end(rehearsal: Rehearsal) -> str:
    """What must happen after a motion that does not end at rest."""
    return "" if rehearsal.at_rest else ", then stop it"


def _moving_at_end(rehearsal: Rehearsal) -> list[str]:
    """The joints that move at the end, with their speeds, that of the fastest first."""
    ends, largest = rehearsal.end_speed[0], rehearsal.speed[0]
    moving = np.flatnonzero(ends > REST_SHARE * largest).tolist()
    moving.sort(key=lambda i: -ends[i] / largest[i])
    return [f"{rehearsal.joints[i]} at {ends[i]:.2g} {rehearsal.units[i]}" for i in moving]


def _unlimited(
    what: str, rehearsal: Rehearsal, names: Sequence[str], values: Array, units: Sequence[str]
) -> str:
    """Say how far quantities go that nothing limits, with the largest of each unit.

    Args:
        what: Name of the quantity.
        rehearsal: The rehearsal.
        names: Names of the joints without a limit.
        values: (n+1, j) values of all joints, of the model and of the robots.
        units: (j,) their units.
    """
    most = np.nanmax(values, axis=0)
    free = [i for i, name in enumerate(rehearsal.joints) if name in names and most[i] > 0.0]
    if not free:
        return ""
    largest: dict[str, int] = {}
    for i in sorted(free, key=lambda i: -most[i]):
        largest.setdefault(units[i], i)
    shown = [f"{most[i]:.2g} {unit} ({rehearsal.joints[i]})" for unit, i in largest.items()]
    which = f"1 {what} has" if len(free) == 1 else f"{len(free)} {what}s have"
    return f"{which} no limit, up to {' and '.join(shown)}"


def _with_interval(design: Design, share: float) -> list[int]:
    """Numbers of the wanted parameters whose predicted 95 % interval is wide.

    Half its width is at least a share of their size.
    """
    widths, least = NORMAL_95 * design.stated_std, share * design.sizes
    is_wide = ~np.isfinite(widths) | ((least > 0.0) & (widths >= least))
    return [j for j in design.wanted if is_wide[j]]


def _reservation(design: Design) -> str:
    """Say what a design does not tell; empty where it determines all and tells more than its start.

    A start outside the limits may tell more.
    """
    undetermined = _with_interval(design, UNDETERMINED_SHARE)
    if undetermined:
        return f"it does not determine {_with_widest(design, undetermined)}"
    if _tells_less(design):
        before, after = _least_eigenvalues(design)
        return (
            f"it tells less than its start (λ_min {before:.3g} → {after:.3g}), because the cost "
            "weighs the control or the tracking more than the information"
        )
    return ""


def _with_widest(design: Design, found: list[int]) -> str:
    """Names of parameters, and the accuracy of that which is known worst."""
    std, sizes = design.stated_std, design.sizes
    names = first_ones([design.parameters[j] for j in found])
    worst = max(found, key=lambda j: float(std[j] / sizes[j]) if np.isfinite(std[j]) else np.inf)
    if not np.isfinite(std[worst]):
        return names
    of_one = f": σ is {relative(std[worst], sizes[worst])} of its size"
    return names + (of_one if len(found) == 1 else f"{of_one} for {design.parameters[worst]}")


def _reservation_of_robots(rehearsal: Rehearsal) -> str:
    """Say what a safe rehearsal leaves open; empty where it leaves nothing open."""
    if not rehearsal.robots:
        return "no robot that differs from the model was rehearsed"
    if not rehearsal.is_clamping:
        return ""
    reached = np.flatnonzero(~rehearsal.kept.all(axis=0) & rehearsal.is_clamped).tolist()
    limits = [rehearsal.limits[i] for i in reached]
    names = first_ones([f"{_kind(limit)} of {limit.name}" for limit in limits])
    free = rehearsal.robots - rehearsal.at_clamp
    return (
        f"only {free} of {rehearsal.robots} robots reach no clamp ({names}); there σ does not hold"
    )


def _tells_less(design: Design) -> bool:
    """Whether a start inside the limits has more information."""
    before, after = _least_eigenvalues(design)
    return _is_allowed(design) and RELEVANT_RATIO * after < before


def _accuracy(design: Design) -> str:
    """The accuracy of the parameter that a design determines worst, in words."""
    shares = design.stated_std / np.where(design.sizes > 0.0, design.sizes, np.nan)
    wanted = [j for j in design.wanted if np.isfinite(shares[j])]
    sentence = f"one experiment of {_seconds(design):.3g} s determines every parameter"
    if not wanted:
        return sentence
    worst = max(wanted, key=lambda j: shares[j])
    name = design.parameters[worst]
    before, after = float(design.initial.std[worst]), float(design.final.std[worst])
    sentence += (
        f" with a σ of {relative(float(design.stated_std[worst]), design.sizes[worst])} or less"
    )
    if not np.isfinite(before):
        return f"{sentence}; the initial motion does not determine {name}"
    if before > SMALL_GAIN * after:
        times = f"{before / after:.3g} times smaller than with the initial motion"
        return f"{sentence} (largest for {name}, {times})"
    return f"{sentence} (largest for {name})"


def _next_steps(design: Design) -> Iterator[str]:
    if not keeps_limits(design):
        yield "Widen the limit that is violated, or begin with an initial control that is smaller."
        return
    if design.rehearsal is not None and not design.rehearsal.is_safe:
        yield from _cures(design.rehearsal)
        return
    if design.is_start and not design.status.success:
        yield "Allow more time or iterations in the table `[descent]` for a better design."
    separable = _is_separable(design)
    if not separable:
        groups = first_ones(design.combinations, "; ")
        yield (
            f"Remove or fix one parameter of each group, give it a prior, or measure another "
            f"output: {groups}."
        )
    wide = _with_interval(design, POORLY_KNOWN_SHARE) if separable else []
    if wide:
        names = first_ones([design.parameters[j] for j in wide])
        yield (
            f"Determine {names} with a longer or larger motion, by measuring another output, or "
            "state what is known with `prior`."
        )
    if _tells_less(design):
        yield "Lower `cost.control` and `cost.tracking` for a design that tells more."
    if is_playable(design):
        yield from PLAY


def _cures(rehearsal: Rehearsal, *, is_designed: bool = True) -> Iterator[str]:
    """What keeps such robots safe, the causes first, and the command to design again.

    Args:
        rehearsal: The rehearsal.
        is_designed: Whether there is a design, which may be played with feedback.
    """
    found = list(_known_cures(rehearsal, is_designed=is_designed))
    yield from found or [
        "Shorten `horizon`: robots differ less from the model in a shorter motion."
    ]
    yield "Then design again: `mjfim design EXPERIMENT -o FOLDER`."


def _known_cures(rehearsal: Rehearsal, *, is_designed: bool) -> Iterator[str]:
    if rehearsal.passes_floor.any():
        other = ' Where it is another one, state `[rehearsal] floor`: its height, or "none".'
        yield (
            f"Keep the robot above the floor: state `clearance` and `floor = {rehearsal.floor:.3g}`"
            " in `[limits]`, or ranges of `position` for what moves down."
            f"{'' if rehearsal.has_floor else other}"
        )
    if rehearsal.is_unstable:
        yield (
            f"Small differences grow {rehearsal.growth:.2g}-fold along this motion. Begin in a "
            "stable rest, such as hanging down (`[initial] qpos` or `keyframe`), or shorten "
            "`horizon`."
        )
    if rehearsal.unbraked and rehearsal.end == "free" and not rehearsal.at_rest:
        yield 'Let the motion end at rest: `[boundary] end = "rest"`.'
    reserve = list(_more_reserve(rehearsal))
    yield from () if rehearsal.kept_reserve else reserve
    if rehearsal.safe_with_feedback:
        yield "With feedback, this motion is safe: `mjfim rehearse DESIGN_FOLDER --feedback`."
    if rehearsal.safe_wrong is None and rehearsal.kept[0].all():
        yield (
            "Say better what is known of the robot: a `prior` of each parameter, or a smaller "
            "`[rehearsal] wrong`."
        )
    elif rehearsal.safe_wrong is not None and np.isfinite(rehearsal.safe_wrong):
        yield (
            f"It is safe on robots that are up to {100.0 * rehearsal.safe_wrong:g} % off: where "
            f"you know yours so well, state `[rehearsal] wrong = {rehearsal.safe_wrong:g}`."
        )
    yield from reserve if rehearsal.kept_reserve else ()
    if is_designed and rehearsal.safe_with_feedback is None and not rehearsal.feedback:
        yield "Try it with feedback: `mjfim rehearse DESIGN_FOLDER --feedback`."


def _more_reserve(rehearsal: Rehearsal) -> Iterator[str]:
    """The reserve that robots need, where the design has less and is not to find it by itself."""
    kept, needed = rehearsal.kept_reserve, rehearsal.reserve
    if kept is None or rehearsal.is_unstable or not needed:
        return
    shares = ", ".join(f"{kind} = {share:g}" for kind, share in (kept | needed).items())
    kind = "larger reserve" if kept else "reserve"
    yield f"Design with a {kind} for such robots: `[limits] reserve = {{ {shares} }}`."


def rehearsal_page(rehearsal: Rehearsal) -> Page:
    """Describe what a design does to robots that differ from the model."""
    seen = " ".join(_observed(rehearsal))
    reservation = _reservation_of_robots(rehearsal)
    if not rehearsal.is_safe:
        verdict = _danger(rehearsal)
    elif reservation:
        text = f"This motion can be played, but {reservation}. {seen}"
        verdict = Verdict(text, Level.DOUBTFUL, ok=True)
    else:
        verdict = Verdict(f"Safe to play{_at_end(rehearsal)}. {seen}", Level.GOOD, ok=True)
    control = "with feedback" if rehearsal.feedback else "open loop"
    return Page(
        kind="Rehearsal of a design",
        verdict=verdict,
        next_steps=PLAY if rehearsal.is_safe else tuple(_cures(rehearsal)),
        facts={
            "robots": str(rehearsal.robots),
            "error of the parameters": f"{100.0 * rehearsal.wrong:g} %",
            "control": control,
        },
        sections={"Rehearsal": _rehearsal_parts(rehearsal)},
    )


def _rehearsal_parts(rehearsal: Rehearsal | None, *, is_detail: bool = False) -> Iterator[Part]:
    if rehearsal is None:
        return
    yield Plot("rehearsal")
    if rehearsal.limits:
        yield replace(_margin_table(rehearsal), detail=is_detail)
    if rehearsal.fans:
        yield _fan_table(rehearsal.fans)
    yield tabulated(
        "Largest speeds and accelerations of the model and of all robots",
        {
            "joint": list(map(named, rehearsal.joints, rehearsal.units)),
            "speed": numbers(rehearsal.speed[0]),
            "of robots": numbers(np.nanmax(rehearsal.speed, axis=0)),
            "at the end": numbers(np.nanmax(rehearsal.end_speed, axis=0)),
            "acceleration": numbers(np.nanmax(rehearsal.acceleration, axis=0)),
            "limited": [
                "no" if name in rehearsal.unlimited else "yes" for name in rehearsal.joints
            ],
        },
        spare=("acceleration", "limited"),
        detail=True,
    )
    is_assumed = np.isfinite(rehearsal.floor) and not rehearsal.has_floor
    yield Text(_surroundings(rehearsal), detail=is_detail or not is_assumed)


def _fan_table(fans: Sequence[Fan]) -> Table:
    """Tabulate how far the robots are apart before and after the experiment."""
    limits = [fan.limit for fan in fans]
    return tabulated(
        "Half width of the range in which 90 % of the robots are, at its widest",
        {
            "quantity": [named(f"{_kind(each)} of {each.name}", each.unit) for each in limits],
            "before": numbers(fan.spread_before for fan in fans),
            "after the experiment": numbers(fan.spread_after for fan in fans),
        },
        detail=True,
    )


def _valley_parts(valley: Valley | None) -> Sequence[Part]:
    """Say which two robots a motion does not tell apart, and tabulate their parameters."""
    if valley is None:
        return ()
    moved = valley.moved
    table = tabulated(
        "Two robots that move alike",
        {
            "parameter": parameter_names(valley, moved),
            "robot 1": numbers(valley.theta[0, moved], 4),
            "robot 2": numbers(valley.theta[1, moved], 4),
            "difference": numbers(np.diff(valley.percent, axis=0)[0, moved], 3, " %"),
        },
        detail=True,
    )
    return Text(str(valley)), Plot("valley"), table


def _surroundings(rehearsal: Rehearsal) -> str:
    """Heights, distances, contacts and stops of all robots in a sentence."""
    parts = []
    lowest = float(np.nanmin(rehearsal.lowest))
    side = "below" if lowest < 0.0 else "above"
    parts.append(f"lowest point {abs(lowest):.3g} m {side} {_floor(rehearsal)}")
    if np.isfinite(rehearsal.nearest).any():
        parts.append(f"smallest distance {np.nanmin(rehearsal.nearest):.3g} m")
    for share, name in ((rehearsal.in_contact, "in contact"), (rehearsal.at_stop, "at a stop")):
        parts.append(f"{name} for up to {100.0 * np.nanmax(share):.2g} % of the time")
    return f"All robots: {', '.join(parts)}."


def _margin_table(rehearsal: Rehearsal) -> Table:
    """Tabulate the limits, the least kept first."""
    worst = finite_or_nan(rehearsal.margins)
    least = np.nanmin(worst, axis=0)
    order = np.argsort(least, kind="stable").tolist()
    limits = [rehearsal.limits[i] for i in order]
    scales = np.array([limit.scale for limit in limits])
    kept = rehearsal.kept[1:, order].sum(axis=0).tolist()
    columns = {
        "limit": [named(f"{_kind(each)} of {each.name}", each.unit) for each in limits],
        "model": numbers(rehearsal.margins[0, order] * scales),
    }
    if rehearsal.robots:
        columns["worst robot"] = numbers(least[order] * scales)
        columns["robots that keep it"] = [f"{count} of {rehearsal.robots}" for count in kept]
    return tabulated(
        f"Margins of the limits on {rehearsal.robots} robots; negative: exceeded",
        columns,
        warned([count < rehearsal.robots for count in kept]),
    )


def _limit_parts(design: Design) -> Iterator[Part]:
    if design.limits:
        yield Plot("limits")
        margins = numbers(design.limits.values())
        columns = {"limit": [*design.limits], "worst margin (negative: violated)": margins}
        yield tabulated("Limits", columns, detail=design.rehearsal is not None)


# ---- sentences


def _accuracy_parts(design: Design) -> Iterator[Part]:
    if design.outcome.lower() not in _verdict(design).sentence.lower():
        yield Text(capitalised(design.outcome), detail=is_playable(design))
    yield _accuracy_table(design)
    learnt = when_learnt(design)
    if learnt:
        yield Text(learnt)
    yield Plot("accuracy_over_time")
    yield Plot("accuracy")
    broken = [str(violation) for violation in design.initial_violations]
    if broken:
        others = len(broken) - MAX_VIOLATIONS
        more = f"; and {others} more, see limits.initial in design.json" if others > 0 else ""
        yield Text(
            f"The initial control violates limits: {'; '.join(broken[:MAX_VIOLATIONS])}{more}. Its "
            "standard deviations are those of a motion outside the limits."
        )
    if design.scaled_start is not None:
        yield Text(_scaled_sentence(design, design.scaled_start))
    before, after = _least_eigenvalues(design)
    yield Text(
        f"λ_min {before:.4g} → {after:.4g} ({after / max(before, TINY):.1f} ×), cost J "
        f"{design.initial.cost:.5g} → {design.final.cost:.5g}, found from the {design.found_by}"
    )
    count = design.iterations
    iterations = "1 iteration" if count == 1 else f"{count} iterations"
    effort = f"{design.seconds:.2f} s, {design.steps / 1e6:.2f} million MuJoCo steps"
    yield Text(f"{iterations}, {effort}", detail=True)
    if design.nuisance:
        names = listed(design.nuisance)
        yield Text(f"Nuisance parameters, whose accuracy the design ignores: {names}", detail=True)
    if design.combinations:
        yield Text(
            "Some parameters are not identifiable alone; the search maximises the information of "
            "combinations of them, see design.json"
        )
    yield Text(sigma_remark(design.inflation, design.parameters), Emphasis.WEAK)


def _scaled_sentence(design: Design, scaled: ScaledStart) -> str:
    """Compare a design with the initial control, scaled until it keeps all limits."""
    reserve = " with the reserve" if design.reserve else ""
    share = f"The initial control scaled by {scaled.share:.2g} keeps all limits{reserve}"
    if not keeps_limits(design):
        return f"{share}; the design does not."
    after = float(design.final.eigenvalues[0])
    times = after / max(scaled.min_eigenvalue, TINY)
    if times > LARGEST_IMPROVEMENT:
        return f"{share}, but then it determines next to nothing."
    if times < RELEVANT_RATIO:
        return f"{share}; the design is no better than that."
    return (
        f"{share}; the design is {times:.3g} times better than that (λ_min "
        f"{scaled.min_eigenvalue:.4g} → {after:.4g})."
    )


# ---- tables


def _accuracy_table(design: Design) -> Table:
    """Tabulate the predicted standard deviations before and after a design."""
    wanted, combined, rows = list(design.wanted), design.combined, design.rows
    sizes = [*design.sizes[wanted], *(abs(each.value) for each in combined)]
    values = [each.value for each in rows]
    before = [each.further["std_initial"] for each in rows]
    after = [each.std for each in rows]
    return tabulated(
        "Predicted standard deviation σ of each parameter after one experiment",
        {
            "parameter": [named(each.name, each.unit) for each in rows],
            "value": numbers(values, 4),
            "σ initial": numbers(before, infinite=NOT_ALONE),
            "relative σ initial": list(map(relative, before, sizes)),
            "σ designed": numbers(after, infinite=NOT_ALONE),
            "relative σ": list(map(relative, after, sizes, values)),
            "change of σ": list(map(improvement, before, after)),
        },
        [Emphasis.NORMAL] * len(wanted) + [Emphasis.DERIVED] * len(combined),
        spare=("value", "relative σ initial"),
    )


def _eigenvalue_table(design: Design) -> Table:
    """Tabulate eigenvalues (largest first), criterion and cost of both trajectories."""
    both = (design.initial, design.final)
    count = len(design.final.eigenvalues)
    shown = range(count) if count <= len(SHOWN_EIGENVALUES) else SHOWN_EIGENVALUES
    eigenvalues = {
        f"λ{k % count + 1}".translate(SUBSCRIPTS): numbers(
            [each.eigenvalues[::-1][k] for each in both], 5
        )
        for k in shown
    }
    return tabulated(
        "Eigenvalues of the Fisher information, and cost",
        {
            "trajectory": ["initial", "designed"],
            **eigenvalues,
            "criterion": numbers([each.criterion for each in both], 5),
            "J": numbers([each.cost for each in both], 5),
        },
        detail=True,
    )


def _start_table(design: Design) -> Table:
    """Tabulate the initial controls from which the search started."""
    starts = design.starts
    return tabulated(
        f"Initial controls from which the search started; the best one: {design.found_by}",
        {
            "initial control": [start.name for start in starts],
            "cost": numbers([start.cost for start in starts], 5),
            "iterations": [str(start.iterations) for start in starts],
            "outcome": [start.status.name.lower() for start in starts],
        },
        detail=True,
    )


def check_page(check: Check) -> Page:
    """Describe predicted standard deviations, and inseparable parameters."""
    title = "The motion of the initial control violates limits; a design looks for one inside:"
    broken = Listing(title, tuple(map(str, check.violations)), detail=True)
    # Nobody plays a start; its margins matter where it is dangerous.
    is_detail = check.is_start and not check.is_dangerous
    return Page(
        kind="Check of an experiment",
        verdict=_check_verdict(check),
        next_steps=tuple(_check_next(check)),
        warnings=tuple(_check_warnings(check)),
        facts={
            "checked": check.source,
            "duration": f"{check.horizon:g} s",
            "parameters": str(len(check.rows)),
            "condition of the information": number(check.condition),
        },
        sections={
            "Accuracy": _check_parts(check),
            "Rehearsal": _rehearsal_parts(check.rehearsal, is_detail=is_detail),
            "Two robots": _valley_parts(check.valley),
            "What would help": worth_parts(check.worth, detail=True),
            "Limits": [broken] if check.violations else (),
        },
    )


def _check_verdict(check: Check) -> Verdict:
    rehearsal = check.rehearsal
    if rehearsal is not None and check.is_dangerous:
        if not check.is_start:
            return _danger(rehearsal)
        text = f"The start falls, and no limit keeps a design from it. {_faults_of(rehearsal)}."
        return Verdict(text, Level.BAD)
    if _has_no_fault(check):
        shares = {row.name: row.relative for row in check.rows if not row.nuisance}
        worst = max(shares, key=lambda name: shares[name])
        sigma = relative(shares[worst], 1.0)
        if NORMAL_95 * shares[worst] >= UNDETERMINED_SHARE:
            does = "do" if check.source.endswith("recordings") else "does"
            text = f"{check.source} {does} not determine {worst}: its σ is {sigma} of its size."
            return Verdict(text, Level.DOUBTFUL, ok=True)
        text = (
            f"All parameters can be identified with {check.source}; the least accurate is {worst} "
            f"with a σ of {sigma}."
        )
        is_doubtful = rehearsal is not None and rehearsal.is_unstable
        return Verdict(text, Level.DOUBTFUL if is_doubtful else Level.GOOD, ok=True)
    return Verdict(as_sentence(check.findings[0]), Level.DOUBTFUL)


def _has_no_fault(check: Check) -> bool:
    """Whether a check found no fault.

    The derivatives agree, all parameters are identifiable, one repetition reaches every stated
    accuracy, and a design would not refuse the experiment. Limits that a start violates are no
    fault, because a design looks for a motion inside. A fall that no limit forbids is one.
    """
    stated = [row for row in check.rows if row.stated and not row.nuisance]
    reached = all(row.repetitions == 1 for row in stated)
    passed = check.self_test.passed and not check.missing and not check.refused
    is_separable = not (unknown_groups(check) or check.not_excited)
    return passed and not check.is_dangerous and is_separable and reached


def _check_warnings(check: Check) -> Iterator[str]:
    """What stands below the verdict: what is wrong, and what the start itself does to robots."""
    rehearsal = check.rehearsal
    if check.is_start and rehearsal is not None and not (rehearsal.is_safe or check.is_dangerous):
        cure = next(_known_cures(rehearsal, is_designed=False), "A design looks for a better one.")
        yield f"Do not play the initial control. {_faults_of(rehearsal)}. {cure}"
    if not _has_no_fault(check):
        yield from (as_sentence(each) for each in check.findings[1:])


def _check_next(check: Check) -> Iterator[str]:
    if check.refused or check.missing:
        return
    if check.rehearsal is not None and check.is_dangerous:
        yield from _cures(check.rehearsal, is_designed=not check.is_start)
    elif check.not_separable:
        yield (
            "Remove or fix one parameter of each group that is identifiable only in combination, "
            "give it a prior, or measure another output."
        )
    elif not (_has_no_fault(check) and check.reaches_all):
        yield "Design a motion that tells more: `mjfim design EXPERIMENT -o FOLDER`."
    elif check.is_start:
        yield "Design a motion that a robot can play: `mjfim design EXPERIMENT -o FOLDER`."
    elif check.rehearsal is None:
        yield "Estimate the parameters: `mjfim identify EXPERIMENT RECORDING -o FOLDER`."
    else:
        yield from PLAY


def _check_parts(check: Check) -> Iterator[Part]:
    if _has_no_fault(check):
        yield Listing("Findings", tuple(as_sentence(each) for each in check.findings))
    yield Table(
        title=f"Accuracy that {check.source} ({check.horizon:g} s) can give",
        columns=("parameter", "value", "σ", "relative σ", "wanted σ", "repetitions", "time"),
        rows=tuple(_row(row) for row in check.rows),
        spare=("value", "wanted σ", "time"),
    )
    yield Plot("check")
    title = "Identifiable only in combination, with this control and with random ones"
    yield from _groups(title, check.not_separable, check)
    yield from _groups("Not excited by this control, but by another one", check.not_excited, check)
    remark = sigma_remark(check.inflation, [row.name for row in check.rows])
    yield Text(remark, Emphasis.WEAK)
    if not len(check.inflation):
        hint = "Logs show more: state their estimate as `earlier` in the experiment file."
        yield Text(hint, detail=True)
    yield Text(_about_self_test(check), detail=True)


def _row(row: ParameterCheck) -> Row:
    name, value = named(row.name, row.unit), number(row.value, 4)
    if row.nuisance:
        return Row((name, value, "nuisance", "", "", "", ""), Emphasis.WEAK)
    cells = (
        name,
        value,
        number(row.std, infinite=NOT_ALONE),
        relative(row.std, row.size, row.value),
        f"{row.wanted:.3g}{'' if row.stated else ' (5 %)'}",
        f"{row.repetitions:,}" if row.repetitions else "-",
        f"{row.seconds:,.0f} s" if row.repetitions else "-",
    )
    return Row(cells, Emphasis.NORMAL if np.isfinite(row.std) else Emphasis.WARNING)


def _groups(title: str, groups: tuple[ParameterGroup, ...], check: Check) -> Iterator[Part]:
    """Groups of parameters, with a line per combination, its value and its σ."""
    accuracy = {each.name: f" = {each.value:.4g} ± {each.std:.2g}" for each in check.combined}
    items = []
    for group in groups:
        combinations = [" ".join(combination_terms(each)) for each in group.combinations]
        lines = [f"  {each}{accuracy.get(each, '')}" for each in combinations]
        members = f"{', '.join(group.members)} only as"
        items.append("\n".join([members, *lines]) if lines else str(group))
    if items:
        yield Listing(f"{title}:", tuple(items), Emphasis.DERIVED)


def _about_self_test(check: Check) -> str:
    test = check.self_test
    if not test.finished:
        return "derivative self-test not finished, because the check was interrupted"
    acting = f"; {first_ones(test.acting)} acts" if test.acting else ""
    return (
        f"derivative self-test {'passed' if test.passed else 'FAILED'}: relative error of psi "
        f"{test.recursion:.1e}, of the slope {test.slope:.1e}{acting}"
    )


def designs_page(comparison: DesignComparison) -> Page:
    """Describe which of two designs determines which parameter better."""
    both = comparison.design, comparison.other
    first, second = ({each.name: each for each in design.each()} for design in both)
    names = [both[0].parameters[j] for j in both[0].wanted]
    shown = [first[name] for name in names if name in second]
    own = np.array([each.std for each in shown])
    other = np.array([second[each.name].std for each in shown])
    worse = [shown[j].name for j in np.flatnonzero(own > (1.0 + TIE_TOLERANCE) * other)]
    better = int(np.sum(other > (1.0 + TIE_TOLERANCE) * own))
    text = "Both designs determine every parameter equally well."
    if worse:
        this = f", and this one {better} of {len(own)} parameters" if better else ""
        text = f"The other design determines {first_ones(worse)} better{this}."
    elif better:
        text = f"This design determines {better} of {len(own)} parameters better, and none worse."
    durations = " s, and of ".join(f"{_seconds(design):.3g}" for design in both)
    table = tabulated(
        f"Predicted σ after one experiment of {durations} s",
        {
            "parameter": [named(each.name, each.unit) for each in shown],
            "σ": numbers(own, infinite=NOT_ALONE),
            "σ of the other": numbers(other, infinite=NOT_ALONE),
            "change of σ": list(map(improvement, other, own)),
        },
    )
    costs = "Cost J {:.4g} against {:.4g}".format(*(design.final.cost for design in both))
    return Page(
        kind="Comparison of two designs",
        verdict=Verdict(text, Level.DOUBTFUL if worse else Level.GOOD, ok=not worse),
        sections={"Accuracy": [table, Text(costs), Text(BEST_CASE, Emphasis.WEAK)]},
    )
