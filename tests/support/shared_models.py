"""Experiments for the models of others, as keyword arguments of `mjfim.Experiment` by name.

Paths of models are relative to `paths.SHARED_MODELS`.
"""

from __future__ import annotations

from typing import Any

# The number pi, as it stands in experiment files.
PI = 3.141592653589793

# Joints of the SO-ARM100.
SO_ARM = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")

# Activations of the six muscles that hold the pose (0.9, 1.2).
ARM26 = {
    "SF": 0.489,
    "SE": 0.41,
    "EF": 0.389,
    "EE": 0.5,
    "BF": 0.36,
    "BE": 0.506,
}

# Joints of the Panda.
PANDA = tuple(f"joint{i}" for i in range(1, 8))


def chirp(amplitude: float, low: float, high: float, **more: Any) -> dict[str, Any]:
    """Return a chirp from one frequency to another [Hz] as initial control."""
    return {
        "kind": "chirp",
        "amplitude": amplitude,
        "frequency": low,
        "frequency_end": high,
        **more,
    }


def state_noise(*joints: str) -> dict[str, float]:
    """Return the noise of encoders [rad or m] and of their rates."""
    return {f"qpos:{j}": 0.002 for j in joints} | {f"qvel:{j}": 0.02 for j in joints}


# The experiments by their names.
EXPERIMENTS = {
    # The pendulum swings about hanging, because its motor is weak against gravity.
    "pendulum": {
        "model": "dmc_pendulum/pendulum.xml",
        "rate": 50.0,
        "horizon": 5.0,
        "initial": {"qpos": (PI,), "control": chirp(0.3, 0.2, 1.5)},
        "parameters": {
            "mass": "body/pole:mass",
            "com": "body/pole:ipos[2]",
            "damping": "joint/hinge:damping",
        },
        "noise": state_noise("hinge"),
        "cost": {"criterion": "E", "control": 2e-4},
        "descent": {"tolerance": 1e-3},
    },
    "cartpole": {
        "model": "dmc_cartpole/cartpole.xml",
        "rate": 100.0,
        "horizon": 4.0,
        "initial": {"qpos": (0.0, PI), "control": chirp(0.25, 0.8, 2.5)},
        "parameters": {
            "cart_mass": "body/cart:mass",
            "pole_mass": "body/pole_1:mass",
            "pole_com": "body/pole_1:ipos[2]",
            # The dampings of the model, 5e-4 and 2e-6, have no visible effect in four seconds.
            "cart_damping": {"target": "joint/slider:damping", "guess": 0.5},
            "pole_damping": {"target": "joint/hinge_1:damping", "guess": 2e-3},
        },
        "noise": state_noise("slider", "hinge_1"),
        "cost": {
            "criterion": "E",
            "control": 4e-3,
            # The weight keeps the cart on its rail.
            "tracking": {"slider": 1e-3},
        },
        "descent": {"tolerance": 1e-3},
    },
    "acrobot": {
        "model": "dmc_acrobot/acrobot.xml",
        "rate": 100.0,
        "horizon": 4.0,
        "initial": {"qpos": (PI, 0.0), "control": chirp(0.5, 0.2, 2.0)},
        "parameters": {
            "upper_mass": "body/upper_arm:mass",
            "lower_mass": "body/lower_arm:mass",
            "upper_com": "body/upper_arm:ipos[2]",
            "lower_com": "body/lower_arm:ipos[2]",
            "shoulder_damping": "joint/shoulder:damping",
            "elbow_damping": "joint/elbow:damping",
        },
        "noise": state_noise("shoulder", "elbow"),
        "cost": {"criterion": "E", "control": 0.2},
        "descent": {"tolerance": 1e-3, "max_iterations": 15},
    },
    # The motor allows a torque of 0.02 N m, and the cable of the arm two radians.
    "furuta": {
        "model": "qube_furuta/furuta_pendulum_implicitfast.xml",
        "rate": 100.0,
        "horizon": 3.0,
        "initial": {"control": chirp(0.004, 1.0, 4.0, offset=-0.0005)},
        "parameters": {
            "arm_damping": "joint/theta:damping",
            "pole_damping": "joint/alpha:damping",
            "arm_armature": {"target": "joint/theta:armature", "guess": 5e-6},
            "motor_gain": "actuator/motor:gainprm[0]",
        },
        "noise": state_noise("theta", "alpha"),
        "cost": {"criterion": "E", "control": 200.0, "tracking": {"theta": 6e-3}},
        "descent": {"tolerance": 1e-2, "max_iterations": 15},
        "limits": {"control": {"motor": (-0.02, 0.02)}, "position": {"theta": (-2.0, 2.0)}},
    },
    # The jaw is open, because the pads of a closed jaw touch.
    "so_arm100": {
        "model": "menagerie_so_arm100/so_arm100_nomesh.xml",
        "rate": 50.0,
        "horizon": 4.0,
        "initial": {
            "qpos": (0.0, -1.57079, 1.57079, 1.57079, -1.57079, 0.5),
            "control": chirp(
                0.1,
                0.3,
                1.2,
                offset={
                    "Rotation": 0.0,
                    "Pitch": -1.57079,
                    "Elbow": 1.57079,
                    "Wrist_Pitch": 1.57079,
                    "Wrist_Roll": -1.57079,
                    "Jaw": 0.5,
                },
            ),
        },
        "parameters": {
            "upper_mass": "body/Upper_Arm:mass",
            "lower_mass": "body/Lower_Arm:mass",
            "lower_com": "body/Lower_Arm:ipos[2]",
            "jaw_mass": "body/Fixed_Jaw:mass",
            "pitch_armature": "joint/Pitch:armature",
            "elbow_armature": "joint/Elbow:armature",
            "pitch_friction": "joint/Pitch:frictionloss",
            "elbow_friction": "joint/Elbow:frictionloss",
        },
        "noise": state_noise(*SO_ARM),
        "cost": {
            "criterion": "E",
            "control": 2.0,
            "control_about": {
                "Pitch": -1.57079,
                "Elbow": 1.57079,
                "Wrist_Pitch": 1.57079,
                "Wrist_Roll": -1.57079,
                "Jaw": 0.5,
            },
            "tracking": dict.fromkeys(SO_ARM, 5.0),
            "tracking_velocity": dict.fromkeys(SO_ARM, 20.0),
        },
        "descent": {"tolerance": 1e-2, "max_iterations": 9},
    },
    # The controls of the six muscles swing about the equilibrium of half activation.
    "arm26": {
        "model": "mj_arm26/arm26_lengthrange.xml",
        "rate": 50.0,
        "horizon": 4.0,
        "initial": {
            "qpos": (0.9, 1.2),
            "act": tuple(ARM26.values()),
            "control": chirp(0.05, 0.8, 2.0, offset=ARM26),
        },
        "parameters": {
            "shoulder_damping": "joint/shoulder:damping",
            "elbow_damping": "joint/elbow:damping",
            "shoulder_armature": {"target": "joint/shoulder:armature", "guess": 0.05},
            "elbow_armature": {"target": "joint/elbow:armature", "guess": 0.02},
        },
        "noise": state_noise("shoulder", "elbow"),
        "cost": {"criterion": "E", "control": 3.0, "control_about": ARM26},
        "descent": {"tolerance": 1e-2, "max_iterations": 60},
    },
    # The unknowns are masses and their centres; the model has neither damping nor armature.
    "panda": {
        "model": "menagerie_panda/panda_nohand_nomesh.xml",
        "rate": 100.0,
        "horizon": 3.0,
        "initial": {"keyframe": "home", "control": chirp(0.02, 0.2, 0.8)},
        "parameters": {
            "link4_mass": "body/link4:mass",
            "link4_com": "body/link4:ipos[1]",
            "link7_mass": "body/link7:mass",
            "link7_com": "body/link7:ipos[2]",
        },
        "noise": state_noise(*PANDA),
        "cost": {
            "criterion": "E",
            # The weights keep the stiff servos (kp 2000 and 500) inside their forcerange when the
            # command jumps.
            "control": {j: 5e5 if j in PANDA[:4] else 1.5e6 for j in PANDA},
        },
        "descent": {"tolerance": 2e-2, "max_iterations": 40},
    },
}
