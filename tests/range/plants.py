"""Plants of the matrix, as MJCF and tables of an experiment file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

# The MJCF at the true parameters, and the tables of the experiment without `model`.
Study = tuple[str, dict[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What is varied from cell to cell.

    Attributes:
        integrator: Integrator of the engine.
        timestep: Timestep of the engine [s].
        mass: Mass of the bodies [kg].
        ratio: Mass of the last body over that of the first.
        horizon: Duration of the experiment [s].
    """

    integrator: str = "RK4"
    timestep: float = 0.005
    mass: float = 1.0
    ratio: float = 1.0
    horizon: float = 2.0

    @property
    def substeps(self) -> int:
        """Engine steps per sample, at about 100 Hz."""
        return max(round(0.01 / self.timestep), 1)

    @property
    def last(self) -> float:
        """Mass of the last body [kg]."""
        return self.mass * self.ratio


def _study(
    setting: Setting,
    body: str,
    motors: str,
    true: dict[str, tuple[str, float]],
    control: dict[str, Any],
    **tables: Any,
) -> Study:
    """Assemble the MJCF and the tables.

    Args:
        setting: Integrator, timestep and horizon.
        body: Elements of the world.
        motors: Elements of the actuators.
        true: Path and true value by name of each parameter; the guess is 10 % larger.
        control: The initial control.
        **tables: Other tables of the experiment.
    """
    xml = (
        '<mujoco><compiler angle="radian" autolimits="true"/>'
        f'<option timestep="{setting.timestep!r}" integrator="{setting.integrator}"/>'
        f"<worldbody>{body}</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    content = {
        "rate": 1.0 / (setting.substeps * setting.timestep),
        "horizon": setting.horizon,
        "parameters": {
            name: {"target": path, "true": value, "guess": 1.1 * value}
            for name, (path, value) in true.items()
        },
        "noise": {"state": 0.01},
        "initial": {"control": control},
        "cost": {"criterion": "A", "control": 1e-3 / setting.mass**2, "linearize_at": "true"},
        "descent": {"max_iterations": 3, "seconds": 60.0},
        "rehearsal": {"robots": 0},
    }
    return xml, {**content, **tables}


def _inertial(mass: float, size: float = 0.1, pos: str = "0 0 0") -> str:
    """The inertia of a body of a size [m], which is a little larger about y than about x."""
    one = mass * size**2
    return f'<inertial pos="{pos}" mass="{mass!r}" diaginertia="{one!r} {1.1 * one!r} {one!r}"/>'


def _sine(frequency: float, **amplitude: float) -> dict[str, Any]:
    """Sines of actuators."""
    return {"kind": "sine", "amplitude": amplitude, "frequency": frequency}


def cart_pendulum(setting: Setting) -> Study:
    """A cart with a hanging, damped pendulum."""
    m, bob = setting.mass, setting.last
    total = m + bob
    body = (
        f'<body name="cart">{_inertial(m)}'
        f'<joint name="slide" type="slide" axis="1 0 0" damping="{total!r}"/>'
        f'<body name="bob"><joint name="hinge" axis="0 1 0" damping="{0.3 * bob!r}"/>'
        f"{_inertial(bob, 0.1, '0 0 -0.5')}</body></body>"
    )
    true = {
        "cart": ("body/cart:mass", m),
        "bob": ("body/bob:mass", bob),
        "damping": ("joint/hinge:damping", 0.3 * bob),
    }
    motor = '<motor name="force" joint="slide"/>'
    return _study(setting, body, motor, true, _sine(0.5, force=5.0 * total))


def inverted_pendulum(setting: Setting) -> Study:
    """A pendulum that begins upright: disturbances grow by a factor of e in 0.3 s."""
    m = setting.mass
    inertial = _inertial(m, 0.1, "0 0 1")
    body = f'<body name="rod"><joint name="hinge" axis="0 1 0"/>{inertial}</body>'
    true = {"mass": ("body/rod:mass", m), "com": ("body/rod:ipos[2]", 1.0)}
    motor = '<motor name="torque" joint="hinge"/>'
    return _study(setting, body, motor, true, _sine(2.0, torque=0.01 * m))


def acrobot(setting: Setting) -> Study:
    """A double pendulum without damping that falls from upright: chaotic."""
    m, last = setting.mass, setting.last
    body = (
        f'<body name="upper">{_inertial(m, 0.2, "0 0 -0.5")}'
        '<joint name="shoulder" axis="0 1 0"/>'
        f'<body name="lower" pos="0 0 -1">{_inertial(last, 0.2, "0 0 -0.5")}'
        '<joint name="elbow" axis="0 1 0"/></body></body>'
    )
    true = {"upper": ("body/upper:mass", m), "lower": ("body/lower:mass", last)}
    motor = '<motor name="torque" joint="elbow"/>'
    control = _sine(1.0, torque=0.5 * min(m, last))
    initial = {"qpos": [2.5, 0.5], "control": control}
    return _study(setting, body, motor, true, control, initial=initial)


def stiff_spring(setting: Setting) -> Study:
    """A mass on a spring of 50 Hz, for timesteps up to 5 ms, and one on a soft spring."""
    m, last = setting.mass, setting.last
    stiff = m * 314.0**2
    body = (
        f'<body name="block">{_inertial(m)}<joint name="stiff" type="slide" axis="1 0 0" '
        f'stiffness="{stiff!r}" damping="{20.0 * m!r}" armature="{0.1 * m!r}"/></body>'
        f'<body name="other">{_inertial(last)}<joint name="soft" type="slide" axis="0 1 0" '
        f'stiffness="{20.0 * last!r}" damping="{last!r}"/></body>'
    )
    true = {
        "stiffness": ("joint/stiff:stiffness", stiff),
        "damping": ("joint/stiff:damping", 20.0 * m),
        "armature": ("joint/stiff:armature", 0.1 * m),
        "soft": ("joint/soft:stiffness", 20.0 * last),
    }
    motors = '<motor name="push" joint="stiff"/><motor name="pull" joint="soft"/>'
    return _study(setting, body, motors, true, _sine(2.0, push=0.3 * stiff, pull=5.0 * last))


def bouncing_ball(setting: Setting) -> Study:
    """A ball that falls on the floor, bounces, and is pushed along it."""
    m = setting.mass
    body = (
        '<geom name="floor" type="plane" size="5 5 0.1" friction="0.5"/>'
        '<body name="ball" pos="0 0 0.3"><joint name="x" type="slide" axis="1 0 0"/>'
        f'<joint name="z" type="slide" axis="0 0 1"/>{_inertial(m)}'
        '<geom name="ball" type="sphere" size="0.1" solref="-1000 -5"/></body>'
    )
    motors = '<motor name="push" joint="x"/><motor name="lift" joint="z"/>'
    control = _sine(1.0, push=8.0 * m, lift=m)
    return _study(setting, body, motors, {"mass": ("body/ball:mass", m)}, control)


def free_body(setting: Setting) -> Study:
    """A body in free flight with four thrusters."""
    m = setting.mass
    body = (
        f'<body name="craft" pos="0 0 1"><freejoint name="base"/>{_inertial(m, 0.2)}'
        '<site name="a" pos="0.2 0 0"/><site name="b" pos="0 0.2 0"/></body>'
    )
    motors = "".join(
        f'<motor name="{name}" site="{site}" gear="{gear} 0 0 0"/>'
        for name, site, gear in (
            ("x", "b", "1 0 0"),
            ("y", "a", "0 1 0"),
            ("z", "a", "0 0 1"),
            ("w", "b", "0 0 1"),
        )
    )
    true = {
        "mass": ("body/craft:mass", m),
        "ixx": ("body/craft:inertia[0]", 0.04 * m),
        "iyy": ("body/craft:inertia[1]", 0.044 * m),
    }
    control = _sine(0.5, x=m, y=0.7 * m, z=0.8 * m, w=0.5 * m)
    return _study(setting, body, motors, true, control)


PLANTS: dict[str, Callable[[Setting], Study]] = {
    "cart-pendulum": cart_pendulum,
    "inverted pendulum": inverted_pendulum,
    "acrobot": acrobot,
    "stiff spring": stiff_spring,
    "bouncing ball": bouncing_ball,
    "free body": free_body,
}
