"""Plants of the matrix, as MJCF and tables of an experiment file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

GRAVITY = 9.81
INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast")


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What is varied from cell to cell.

    Attributes:
        integrator: Integrator of the engine.
        timestep: Timestep of the engine [s].
        mass: Mass of the bodies [kg].
        ratio: Mass of the last body over that of the first.
        horizon: Duration of the experiment [s].
        rate: Samples per second; None for about 100 Hz [Hz].
    """

    integrator: str = "RK4"
    timestep: float = 0.005
    mass: float = 1.0
    ratio: float = 1.0
    horizon: float = 2.0
    rate: float | None = None

    @property
    def substeps(self) -> int:
        """Engine steps per sample."""
        wanted = 0.01 if self.rate is None else 1.0 / self.rate
        return max(round(wanted / self.timestep), 1)

    @property
    def option(self) -> str:
        """The element of the MJCF with timestep and integrator."""
        return f'<option timestep="{self.timestep!r}" integrator="{self.integrator}"'

    def __str__(self) -> str:
        ratio = "" if self.ratio == 1.0 else f", then x {self.ratio:g}"
        rate = 1.0 / (self.substeps * self.timestep)
        return (
            f"{self.integrator}, {self.timestep:g} s, {self.mass:g} kg{ratio}, "
            f"{self.horizon:g} s at {rate:g} Hz"
        )


@dataclass(frozen=True, kw_only=True)
class Study:
    """A plant with everything that an experiment states about it.

    Attributes:
        xml: The MJCF at the true parameters.
        tables: Tables of the experiment file, without `model`.
    """

    xml: str
    tables: dict[str, Any]


def _study(
    setting: Setting,
    body: str,
    actuators: str,
    true: dict[str, tuple[str, float]],
    control: dict[str, Any],
    *,
    extra: str = "",
    flags: str = '<flag contact="disable"/>',
    gravity: float = GRAVITY,
    tables: dict[str, Any] | None = None,
) -> Study:
    """Assemble the MJCF and the tables.

    Args:
        setting: Integrator, timestep and horizon.
        body: Elements of the world.
        actuators: Elements of the actuators.
        true: Path and true value by name of each parameter; the guess is 10 % larger.
        control: The initial control.
        extra: Further elements of the MJCF.
        flags: Contents of the element `option`.
        gravity: Gravity [m/s^2].
        tables: Further tables.
    """
    xml = (
        '<mujoco><compiler angle="radian" autolimits="true"/>\n'
        f'{setting.option} gravity="0 0 {-gravity!r}">{flags}</option>\n'
        f"<worldbody>{body}</worldbody>\n<actuator>{actuators}</actuator>\n{extra}</mujoco>\n"
    )
    parameters = {
        name: {"target": path, "true": value, "guess": 1.1 * value}
        for name, (path, value) in true.items()
    }
    content = {
        "rate": 1.0 / (setting.substeps * setting.timestep),
        "horizon": setting.horizon,
        "parameters": parameters,
        "noise": {"state": 0.01},
        "initial": {"control": control},
        "cost": {"criterion": "A", "control": 1e-3 / setting.mass**2, "linearize_at": "true"},
        "descent": {"max_iterations": 3, "seconds": 60.0},
    }
    for name, table in (tables or {}).items():
        content[name] = {**content.get(name, {}), **table}
    return Study(xml=xml, tables=content)


def _inertial(mass: float, size: float = 0.1, pos: str = "0 0 0") -> str:
    """The inertia of a body of a size [m]."""
    inertia = mass * size**2
    return (
        f'<inertial pos="{pos}" mass="{mass!r}" diaginertia="{inertia!r} {inertia!r} {inertia!r}"/>'
    )


def _sine(name: str, amplitude: float, frequency: float = 0.5) -> dict[str, Any]:
    """A sine of one actuator."""
    return {"kind": "sine", "amplitude": {name: amplitude}, "frequency": frequency}


def cart_pendulum(setting: Setting) -> Study:
    """A cart with a hanging, damped pendulum."""
    m, bob = setting.mass, setting.mass * setting.ratio
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
    return _study(setting, body, motor, true, _sine("force", 5.0 * total))


def inverted_pendulum(setting: Setting) -> Study:
    """A pendulum that begins upright: disturbances grow by a factor of e in 0.3 s."""
    m = setting.mass
    body = (
        '<body name="rod"><joint name="hinge" axis="0 1 0"/>'
        + _inertial(m, 0.1, "0 0 1")
        + "</body>"
    )
    true = {"mass": ("body/rod:mass", m), "com": ("body/rod:ipos[2]", 1.0)}
    motor = '<motor name="torque" joint="hinge"/>'
    return _study(setting, body, motor, true, _sine("torque", 0.01 * m, 2.0))


def acrobot(setting: Setting) -> Study:
    """A double pendulum without damping that falls from upright: chaotic."""
    m, last = setting.mass, setting.mass * setting.ratio
    body = (
        f'<body name="upper">{_inertial(m, 0.2, "0 0 -0.5")}'
        '<joint name="shoulder" axis="0 1 0"/>'
        f'<body name="lower" pos="0 0 -1">{_inertial(last, 0.2, "0 0 -0.5")}'
        '<joint name="elbow" axis="0 1 0"/></body></body>'
    )
    true = {"upper": ("body/upper:mass", m), "lower": ("body/lower:mass", last)}
    motor = '<motor name="torque" joint="elbow"/>'
    start = {"qpos": [2.5, 0.5]}
    control = _sine("torque", 0.5 * min(m, last), 1.0)
    return _study(setting, body, motor, true, control, tables={"initial": start})


def stiff_spring(setting: Setting) -> Study:
    """A mass on a spring of 50 Hz, for timesteps up to 5 ms, and one on a soft spring."""
    m, last = setting.mass, setting.mass * setting.ratio
    stiff = m * 314.0**2
    body = (
        f'<body name="block">{_inertial(m)}<joint name="stiff" type="slide" axis="1 0 0" '
        f'stiffness="{stiff!r}" damping="{20.0 * m!r}"/></body>'
        f'<body name="other">{_inertial(last)}<joint name="soft" type="slide" axis="0 1 0" '
        f'stiffness="{20.0 * last!r}" damping="{last!r}"/></body>'
    )
    true = {
        "stiffness": ("joint/stiff:stiffness", stiff),
        "damping": ("joint/stiff:damping", 20.0 * m),
        "soft": ("joint/soft:stiffness", 20.0 * last),
    }
    motors = '<motor name="push" joint="stiff"/><motor name="pull" joint="soft"/>'
    amplitude = {"push": 0.3 * stiff, "pull": 5.0 * last}
    control = {"kind": "sine", "amplitude": amplitude, "frequency": 2.0}
    return _study(setting, body, motors, true, control)


def bouncing_ball(setting: Setting) -> Study:
    """A ball that falls on the floor, bounces, and is pushed along it."""
    m = setting.mass
    body = (
        '<geom name="floor" type="plane" size="5 5 0.1" friction="0.5"/>'
        '<body name="ball" pos="0 0 0.3"><joint name="x" type="slide" axis="1 0 0"/>'
        '<joint name="z" type="slide" axis="0 0 1"/>'
        f"{_inertial(m)}"
        '<geom name="ball" type="sphere" size="0.1" solref="-1000 -5"/></body>'
    )
    true = {"mass": ("body/ball:mass", m)}
    motors = '<motor name="push" joint="x"/><motor name="lift" joint="z"/>'
    control = {"kind": "sine", "amplitude": {"push": 8.0 * m, "lift": m}, "frequency": 1.0}
    return _study(setting, body, motors, true, control, flags="")


def free_body(setting: Setting) -> Study:
    """A free body with four thrusters, without gravity and damping."""
    m = setting.mass
    body = (
        '<body name="craft" pos="0 0 1"><freejoint name="base"/>'
        f"{_inertial(m, 0.2)}"
        '<site name="a" pos="0.2 0 0"/><site name="b" pos="0 0.2 0"/>'
        '<site name="mark"/></body>'
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
    inertia = 0.04 * m
    true = {
        "mass": ("body/craft:mass", m),
        "ixx": ("body/craft:inertia[0]", inertia),
        "iyy": ("body/craft:inertia[1]", 1.1 * inertia),
    }
    body = body.replace(
        f'diaginertia="{m * 0.2**2!r} {m * 0.2**2!r} {m * 0.2**2!r}"',
        f'diaginertia="{inertia!r} {1.1 * inertia!r} {1.2 * inertia!r}"',
    )
    sensors = (
        '<sensor><framepos name="position" objtype="site" objname="mark"/>'
        '<framequat name="orientation" objtype="body" objname="craft"/>'
        '<gyro name="gyro" site="mark"/></sensor>'
    )
    amplitude = {"x": m, "y": 0.7 * m, "z": 0.8 * m, "w": 0.5 * m}
    control = {"kind": "sine", "amplitude": amplitude, "frequency": 0.5}
    noise = {"position": 0.01, "orientation": 0.01, "gyro": 0.01}
    study = _study(
        setting, body, motors, true, control, extra=sensors, gravity=0.0, tables={"noise": noise}
    )
    study.tables["noise"].pop("state")
    return study


def arm(setting: Setting) -> Study:
    """The planar arm of models/ with its two damped joints, with all masses and forces scaled."""
    m, fore = setting.mass, setting.mass * setting.ratio
    body = (
        f'<body name="upper"><inertial pos="0 0 -0.2" mass="{2.0 * m!r}" '
        f'diaginertia="{0.03 * m!r} {0.03 * m!r} {0.003 * m!r}"/>'
        f'<joint name="shoulder" axis="0 -1 0" damping="{0.8 * (m + fore)!r}" '
        f'stiffness="{2.0 * m!r}" armature="{0.02 * m!r}"/>'
        f'<body name="fore" pos="0 0 -0.4"><inertial pos="0 0 -0.15" mass="{1.2 * fore!r}" '
        f'diaginertia="{0.012 * fore!r} {0.012 * fore!r} {0.001 * fore!r}"/>'
        f'<joint name="elbow" axis="0 -1 0" damping="{0.3 * fore!r}" '
        f'stiffness="{fore!r}" armature="{0.02 * fore!r}"/></body></body>'
    )
    true = {
        "payload": ("body/fore:mass", 1.2 * fore),
        "damping": ("joint/elbow:damping", 0.3 * fore),
        "armature": ("joint/shoulder:armature", 0.02 * m),
    }
    motors = '<motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow"/>'
    amplitude = {"shoulder": 8.0 * (m + fore), "elbow": 2.0 * fore}
    control = {"kind": "sine", "amplitude": amplitude, "frequency": 0.7}
    return _study(setting, body, motors, true, control)


PLANTS: dict[str, Callable[[Setting], Study]] = {
    "cart-pendulum": cart_pendulum,
    "inverted pendulum": inverted_pendulum,
    "acrobot": acrobot,
    "stiff spring": stiff_spring,
    "bouncing ball": bouncing_ball,
    "free body": free_body,
    "arm": arm,
}
