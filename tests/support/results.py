"""Made-up results of every verb, for tests of how they are shown; nothing is simulated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mjfim.arrays import Array
from mjfim.records.check import Check, ParameterCheck, SelfTest
from mjfim.records.design import (
    Design,
    Evaluation,
    LimitUsage,
    Status,
)
from mjfim.records.estimate import (
    Estimate,
    HorizonStudy,
    ParameterDraws,
    Prediction,
    PredictionErrors,
    Whiteness,
)
from mjfim.records.estimate_parts import InformationInTime, ResidualForce
from mjfim.records.rehearsal import (
    Fan,
    FiniteSteps,
    LimitRange,
    Rehearsal,
)
from mjfim.records.robots import RobotComparison
from mjfim.records.studies import (
    DESIGN,
    Campaign,
    CampaignStatus,
    Comparison,
    MethodOutcome,
    MonteCarloStudy,
    Round,
    TrialStatistics,
)
from mjfim.records.terms import Term, TermNumber
from mjfim.records.trajectory import Labels, Recording
from mjfim.records.worth import Price, SensorWorth, Watch, Worth
from tests.support.made_records import (
    bare_estimate,
    falling,
    make_comparison,
    make_evaluation,
    make_method_result,
    make_recording_comparison,
    ten_iterates,
)

# Names of the parameters of all results.
PARAMETERS = ("mass", "length", "damping")
UNITS = ("kg", "m", "N m s/rad")
THETA = np.array([2.0, 1.0, 0.5])

# Bound of the position of a design [rad].
BOUND = 1.125

# Correlation of the estimates of the first two parameters.
CORRELATION = 0.8

# A term that a selection has added to the cart-pendulum.
SLIDE_FRICTION = Term(
    description="dry friction of slide",
    numbers=(
        TermNumber(
            name="slide_frictionloss",
            path="joint/slide:frictionloss",
            value=0.5,
            unit="N",
            scale=0.5,
        ),
    ),
)


def labels(name: str = "hinge") -> Labels:
    """Labels of a model with one joint."""
    return Labels(
        qpos=(f"{name} [rad]",),
        positions=(f"{name} [rad]",),
        velocities=(f"{name} velocity [rad/s]",),
        controls=("motor [N m]",),
        parameters=PARAMETERS,
        parameter_units=UNITS,
        outputs={f"qpos:{name}": f"qpos:{name} [rad]"},
    )


def covariance(std: Array) -> Array:
    """Covariance with these standard deviations, in which the first two are correlated."""
    correlation = np.eye(len(std))
    correlation[0, 1] = correlation[1, 0] = CORRELATION
    return correlation * np.outer(std, std)


def evaluation(size: float, samples: int) -> Evaluation:
    """A sinusoid of a given size; a larger one tells more."""
    made, std = make_evaluation(1, 3, size, samples, speed=6.0), 0.01 / size * THETA
    return replace(
        made,
        sensitivity=np.zeros((samples + 1, 2, 3)),
        information=np.linalg.inv(covariance(std)),
        std=std,
        std_over_time=falling(std, made.trajectory.t),
        cost=made.criterion,
    )


def design(name: str = "hinge", samples: int = 50, **changes: object) -> Design:
    """A design of ten iterations within a limit of the position."""
    history = ten_iterates()
    final = evaluation(1.0, samples)
    share = 0.9 * final.trajectory.qpos[:, 0]
    fields = {
        "status": Status.CONVERGED,
        "parameters": PARAMETERS,
        "theta": THETA,
        "initial": evaluation(0.1, samples),
        "final": final,
        "history": history,
        "slope": 1e-8,
        "steps": 1000,
        "seconds": 1.5,
        "limits": {"position": 0.1},
        "usage": (
            LimitUsage(
                kind="position",
                name=name,
                t=final.trajectory.t,
                share=share,
                lower=-BOUND,
                upper=BOUND,
            ),
        ),
        "labels": labels(name),
        "rehearsal": rehearsal(name, steps=finite_steps(predicted=final.std)),
    }
    return Design(**{**fields, **changes})


def estimate(name: str = "hinge", samples: int = 200, **changes: object) -> Estimate:
    """An estimate from one recording, with a prediction of another one."""
    t = np.linspace(0.0, 2.0, samples + 1)
    predicted = np.sin(6.0 * t)[:, None]
    noise = 0.05 * np.random.default_rng(0).normal(size=predicted.shape)
    output = f"qpos:{name}"
    recording = Recording(
        t=t,
        ctrl=np.zeros((samples, 1)),
        y=predicted + noise,
        outputs=(output,),
        name="logs/swing.csv",
    )
    std = 0.01 * THETA
    errors = [
        PredictionErrors(name="new", outputs=(output,), rms=np.array([rms]), mae=np.array([rms]))
        for rms in (0.05, 0.2)
    ]
    fields = {
        "parameters": PARAMETERS,
        "theta": THETA,
        "std": std,
        "units": UNITS,
        "covariance": covariance(std),
        "chi2": 201.0,
        "dof": 198,
        "residual_rms": {output: 0.05},
        "sigma": {output: 0.05},
        "predicted": (predicted,),
        "recordings": (recording,),
        "nominal": (0.7 * predicted,),
        "segments": (np.array([0.0, 1.0]),),
        "whiteness": (
            Whiteness(
                output=output,
                count=samples,
                variance=1.0,
                correlation=0.01,
                p=0.4,
                inflation=1.0,
                time=1.0,
            ),
        ),
        "predictions": (
            Prediction(
                name="logs/new.csv",
                identified=errors[0],
                nominal=errors[1],
                held_out=True,
                recording=recording,
                identified_outputs=predicted,
                nominal_outputs=0.8 * predicted,
            ),
        ),
        "labels": labels(name),
        "draws": draws(std),
        "recording_comparison": make_recording_comparison(
            PARAMETERS, UNITS, ("swing.csv", "other.csv", "third.csv")
        ),
    }
    return bare_estimate(**{**fields, **changes})


def draws(std: Array) -> ParameterDraws:
    """Thirty drawn robots."""
    noise = np.random.default_rng(1).normal(size=(30, len(std)))
    return ParameterDraws(
        parameters=PARAMETERS,
        units=UNITS,
        values=THETA + std * noise,
        centre=THETA,
        std=std,
        replaced=2,
        seed=0,
    )


def horizons(
    theta: Array = THETA,
    parameters: tuple[str, ...] = PARAMETERS,
    units: tuple[str, ...] = UNITS,
) -> HorizonStudy:
    """Four lengths of segments, on which some parameters depend."""
    found = np.outer([1.2, 1.1, 1.0, 0.9], theta)
    apart = np.zeros(found.shape, dtype=bool)
    apart[0, ::2] = True
    return HorizonStudy(
        lengths=np.array([0.12, 0.48, 1.9, 4.0]),
        errors=np.array([1.1, 1.2, 1.8, 5.0]) * np.ones((4, 1)),
        chosen=2,
        is_whole=True,
        parameters=parameters,
        units=units,
        theta=found,
        half_widths=0.05 * found,
        is_apart=apart,
    )


def residual_forces(*joints: str) -> tuple[ResidualForce, ...]:
    """Residual forces of joints."""
    speed = np.sin(np.linspace(0.0, 40.0, 300))
    force = np.sign(speed) + 0.1 * np.random.default_rng(1).normal(size=300)
    curves = {"position": np.cumsum(speed), "speed": speed, "force": force}
    return tuple(
        ResidualForce(joint=joint, unit="N m", sigma=0.1, size=2.0, **curves) for joint in joints
    )


def information_in_time(parameters: tuple[str, ...], end: float) -> InformationInTime:
    """Information of ten blocks of the recording, up to an end [s]."""
    edges, shape = np.linspace(0.0, end, 11), (10, len(parameters))
    return InformationInTime(
        parameters=parameters,
        recording=np.zeros(10),
        times=np.column_stack([edges[:-1], edges[1:]]),
        shares=np.full(shape, 0.09),
        pulls=np.resize([-2.0, 2.0], shape),
        scatter=1.0,
    )


def missing_term() -> Term:
    """A term that the residuals ask for."""
    return Term(
        description="dry friction of the hinge",
        numbers=(TermNumber(path="joint/hinge:frictionloss", value=0.1, unit="N m", scale=0.1),),
        sigmas=12.0,
        share=0.3,
    )


def check(parameters: tuple[str, ...] = PARAMETERS, **changes: object) -> Check:
    """A check of three parameters, of which the first two are confounded."""
    rows = tuple(
        ParameterCheck(
            name=name,
            unit=unit,
            value=value,
            nuisance=False,
            size=value,
            std=0.02 * value,
            relative=0.02,
            wanted=0.05 * value,
            stated=False,
            repetitions=1,
            seconds=2.0,
        )
        for name, unit, value in zip(parameters, UNITS, THETA.tolist(), strict=True)
    )
    std = np.array([row.std for row in rows])
    made = Check(
        source="the initial control",
        horizon=2.0,
        rows=rows,
        wanted=parameters,
        information=np.linalg.inv(covariance(std)),
        eigenvalues=np.array([1.0, 2.0, 30.0]),
        correlation=covariance(np.ones(3)),
        not_separable=(),
        not_excited=(),
        self_test=SelfTest(recursion=1e-8, slope=1e-6),
        findings=("every identifiable parameter reaches its wanted σ",),
        is_start=True,
    )
    return replace(made, **changes)


def comparison(**changes: object) -> Comparison:
    """A design that is better than one baseline, and one baseline that violates a limit."""
    rows = tuple(
        make_method_result(
            method,
            cost,
            title=title,
            outcome=outcome,
            control=np.zeros((4, 1)),
            std=0.01 * cost * THETA,
            min_eigenvalue=1.0 / cost,
            worst_relative_std=0.01 * cost,
            steps=1000,
            margins={"position": 0.1},
            relative_margins={"position": 0.1},
        )
        for method, title, cost, outcome in (
            ("chirp", "chirp", 2.0, MethodOutcome.INSIDE),
            ("multisine", "multisine", 0.5, MethodOutcome.OUTSIDE),
            (DESIGN, "mjfim's design", 1.0, MethodOutcome.INSIDE),
        )
    )
    made = make_comparison(
        *rows, source="study.toml", parameters=PARAMETERS, units=UNITS, scale=THETA
    )
    return replace(made, **changes)


def trials(std: Array, seed: int) -> TrialStatistics:
    """Estimates whose scatter is that of the bound."""
    bound = covariance(std)
    estimates = np.random.default_rng(seed).multivariate_normal(THETA, bound, size=200)
    return TrialStatistics(
        estimates=estimates,
        mean=estimates.mean(axis=0),
        covariance=np.cov(estimates.T),
        crlb=bound,
        efficiency=np.array([1.0, 0.95, 1.1]),
        efficiency_interval=np.array([[0.8, 1.2], [0.75, 1.15], [0.9, 1.3]]),
        trials=200,
        failed=0,
        seconds=1.0,
    )


def study(parameters: tuple[str, ...] = PARAMETERS, **changes: object) -> MonteCarloStudy:
    """Trials along the initial and the designed trajectory."""
    sets = {"initial": trials(0.1 * THETA, 0), "final": trials(0.01 * THETA, 1)}
    made = MonteCarloStudy(
        parameters=parameters,
        theta=THETA,
        measure_rate=100.0,
        sets=sets,
        information={name: np.linalg.inv(found.crlb) for name, found in sets.items()},
        labels=replace(labels(), parameters=parameters),
    )
    return replace(made, **changes)


def finite_steps(
    parameters: tuple[str, ...] = PARAMETERS, predicted: np.ndarray = 0.01 * THETA
) -> FiniteSteps:
    """Standard deviations that finite steps confirm."""
    return FiniteSteps(
        names=parameters,
        predicted=predicted,
        std=predicted,
        length=np.full(3, 2.0),
        ratio=np.ones(3),
    )


def fan(limit: LimitRange) -> Fan:
    """A sine on robots that are up to 20 % off, and 2 % after the experiment."""
    t = np.linspace(0.0, 2.0, 50)
    model = 0.6 * np.sin(6.0 * t)
    before, after = (np.outer([-each, each], t) + model for each in (0.1, 0.01))
    return Fan(limit=limit, t=t, model=model, worst=1.15 * model, before=before, after=after)


def rehearsal(
    name: str = "hinge", parameters: tuple[str, ...] = PARAMETERS, **changes: object
) -> Rehearsal:
    """Twenty robots that keep all limits, or some of which exceed one for small margins."""
    random = np.random.default_rng(0)
    rows = np.ones((21, 1))
    limits = tuple(
        LimitRange(kind=kind, name=name, lower=-1.0, upper=1.0, scale=1.0, unit=unit)
        for kind, unit in (("position", "rad"), ("velocity", "rad/s"))
    )
    made = Rehearsal(
        parameters=parameters,
        wrong=0.2,
        feedback=False,
        latency=0.0,
        theta=THETA * (1.0 + 0.2 * random.uniform(-1.0, 1.0, (21, 3))),
        limits=limits,
        margins=np.array([0.4, 0.5]) + 0.1 * random.uniform(-1.0, 1.0, (21, 2)),
        joints=("slide", name),
        units=("m/s", "rad/s"),
        speed=rows * np.array([0.5, 0.6]),
        acceleration=rows * np.array([5.0, 6.0]),
        end_speed=rows * np.array([0.001, 0.002]),
        travel=rows * np.array([0.3, 1.2]),
        unlimited=("slide",),
        unplaced=("slide",),
        lowest=0.2 * rows[:, 0],
        floor=0.0,
        has_floor=True,
        depth=0.01,
        end_height=0.3 * rows[:, 0],
        nearest=0.1 * rows[:, 0],
        in_contact=0.0 * rows[:, 0],
        at_stop=0.0 * rows[:, 0],
        unbraked={},
        steps=finite_steps(parameters),
        fans=tuple(map(fan, limits)),
        motion_times=np.array([0.0, 2.0]),
        motions={1: 0.1 * rows[:2], 2: 0.2 * rows[:2]},
    )
    return replace(made, **changes)


def campaign(parameters: tuple[str, ...] = PARAMETERS, **changes: object) -> Campaign:
    """Two rounds after which every target is reached."""
    rounds = tuple(
        Round(
            number=number,
            theta=1.2 * THETA,
            predicted=0.02 / number * THETA,
            control=np.zeros((200, 1)),
            recordings=estimate().recordings,
            estimate=estimate(parameters=parameters, std=0.02 / number * THETA),
        )
        for number in (1, 2)
    )
    made = Campaign(
        parameters=parameters,
        wanted=0.015 * THETA,
        rounds=rounds,
        status=CampaignStatus.REACHED,
    )
    return replace(made, **changes)


def robots(**changes: object) -> RobotComparison:
    """Two robots whose damping differs."""
    std = 0.01 * THETA
    made = RobotComparison(
        names=("monday", "friday"),
        recordings=(3, 1),
        parameters=PARAMETERS,
        units=UNITS,
        is_single=np.array([1.0, 0.0, 1.0]),
        values=np.array([THETA, THETA + np.array([0.0, 0.001, 0.2])]),
        std=np.array([std, 1.5 * std]),
        interval=np.array([[-0.07, 0.07], [-0.04, 0.04], [0.18, 0.22]]),
        p=np.array([1.0, 0.8, 1e-20]),
        detectable=np.array([0.12, 0.06, 0.03]),
        joint_p=1e-18,
        level=0.05,
        remarks=("of friday there is a single recording",),
    )
    return replace(made, **changes)


def worth(parameters: tuple[str, ...] = PARAMETERS, **changes: object) -> Worth:
    """What two sensors of an experiment and an added one tell, and two prices."""
    std = np.array([0.02, 0.01, 0.03])

    def sensor(name: str, factor: float, *, is_added: bool = False) -> SensorWorth:
        """A sensor without which σ is larger by a factor."""
        present = std / factor if is_added else std
        return SensorWorth(
            name=name,
            noise="0.05 rad",
            is_added=is_added,
            without=present * factor,
            present=present,
            alone=np.array([0.3, np.inf, 0.1]),
            halved=present / 1.4,
        )

    made = Worth(
        source="the design",
        horizon=4.0,
        parameters=parameters,
        units=UNITS,
        target=0.05 * THETA,
        is_stated=True,
        std=std,
        repeated=std / np.sqrt(2.0),
        faster=std / np.sqrt(2.0),
        sensors=(
            sensor(f"angle of {parameters[0]}", 1.0),
            sensor("rate", 3.0),
            sensor("gyro of bob", 2.0, is_added=True),
        ),
        fewest=("rate", "gyro of bob"),
        prices=(
            Price(name="control of motor", step="10 % wider", predicted=-0.07, redesigned=-0.068),
            Price(name="time", step="0.4 s more"),
        ),
    )
    return replace(made, **changes)


def watch(**changes: object) -> Watch:
    """A stream of 12 s, after which one of three parameters is known well enough."""
    t = np.linspace(0.0, 12.0, 60)
    std = np.outer(1.0 / np.sqrt(np.maximum(t, 0.1)), THETA * np.array([0.1, 0.2, 0.4]))
    made = Watch(
        parameters=PARAMETERS,
        units=UNITS,
        sizes=np.abs(THETA),
        wanted=0.05 * np.abs(THETA),
        is_stated=True,
        t=t,
        std_over_time=std,
        reached=np.array([4.0, np.inf, np.inf]),
        rows=1200,
        left_out=2,
    )
    return replace(made, **changes)


# Function that makes the result of each verb.
MAKERS = {
    "compare-robots": robots,
    "design": design,
    "identify": estimate,
    "check": check,
    "compare": comparison,
    "montecarlo": study,
    "rehearse": rehearsal,
    "worth": worth,
    "watch": watch,
    "campaign": campaign,
}
