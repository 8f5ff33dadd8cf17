"""Cases of the golden results: command lines of `mjfim`, without its name.

A case is one or several command lines, divided by ` ; `. They run in a folder that holds the
repository's models and, as `shared`, measured data and public models. A word such as
`cart_pendulum+descent.starts=2` is the experiment file with these keys changed.
"""

from __future__ import annotations

CASES: dict[str, str] = {
    # One command for each model.
    "check cart": "check cart_pendulum.toml -o o",
    "check servo arm": "check servo_arm.toml -o o",
    "check quadrotor": "check quadrotor.toml -o o",
    "check double pendulum": "check double_pendulum.toml -o o",
    "check four bar": "check four_bar.toml -o o",
    "check muscles": "check muscle_arm.toml -o o",
    "check drive": "check filtered_drive.toml -o o",
    "check ball": "check ball_pendulum.toml -o o",
    "check block": "check sliding_block.toml -o o",
    "check release": "check free_pendulum.toml -o o",
    "check load": "check payload/load.toml -o o",
    "list": "list cart_pendulum.xml --json",
    "list panda": "list shared/models/menagerie_panda/panda_nohand_nomesh.xml --json",
    "validate": "validate servo_arm.toml --json",
    "validate schema": "validate --schema",
    "init panda": "init shared/models/menagerie_panda/panda_nohand_nomesh.xml -o p.toml"
    " ; validate p.toml --json",
    "init so_arm": "init shared/models/menagerie_so_arm100/so_arm100_nomesh.xml -o p.toml"
    " ; check p.toml -o o",
    # Designs.
    "design cart": "design cart_pendulum.toml -o o",
    "design guess": "design cart_pendulum_guess.toml -o o",
    "design metric": "design cart_pendulum+descent.method=metric -o o",
    "design D": "design cart_pendulum+cost.criterion=D -o o",
    "design starts": "design cart_pendulum+descent.starts=4+descent.max_iterations=30 -o o",
    "design workers": "design cart_pendulum+descent.starts=4+descent.max_iterations=30 -o o"
    " --executor local:2",
    "design double": "design double_pendulum+descent.max_iterations=20 -o o",
    "design four bar": "design four_bar+descent.max_iterations=15 -o o",
    "design muscles": "design muscle_arm+descent.max_iterations=15 -o o",
    "design drive": "design filtered_drive+descent.max_iterations=15 -o o",
    "design ball": "design ball_pendulum+descent.max_iterations=10 -o o",
    "design servo": "design servo_arm+descent.max_iterations=8 -o o",
    "design release": "design free_pendulum.toml -o o",
    "design robust": "design cart_pendulum_guess+robust.samples=3+descent.max_iterations=15 -o o",
    "design shortest": "design cart_pendulum+descent.max_iterations=20"
    "+parameters.m.wanted=0.01 -o o --shortest",
    "design previous": "design cart_pendulum+descent.max_iterations=10 -o a"
    ' ; design cart_pendulum+descent.previous=[\\"a/design.csv\\"]+descent.max_iterations=40 -o o',
    # Hard limits.
    "limits": "design cart_pendulum_limits+boundary.end=free+descent.starts=1"
    "+descent.max_iterations=60 -o o",
    "limits starts": "design cart_pendulum_limits+boundary.end=free+descent.starts=3"
    "+descent.seconds=8 -o o",
    "limits velocity": "design cart_pendulum_limits+boundary.end=free+descent.starts=1"
    "+limits.velocity=2.0+descent.seconds=8 -o o",
    "limits rest": "design cart_pendulum_limits+descent.starts=1+limits.bandwidth=5.0"
    "+boundary.start=rest+boundary.end=rest+descent.seconds=8 -o o",
    "limits torque": "design double_pendulum+limits.velocity=6.0+limits.control.shoulder=[-4,4]"
    "+limits.control.elbow=[-4,4]+descent.starts=2+descent.seconds=8 -o o",
    "limits block": "design sliding_block+descent.starts=1+descent.seconds=8 -o o",
    "limits infeasible": "design cart_pendulum_limits+boundary.end=free"
    "+limits.position.slide=[0.5,1.0] -o o",
    # Simulated recordings and estimates.
    "identify cart": "simulate cart_pendulum_guess.toml -o r.csv"
    " ; identify cart_pendulum_guess.toml r.csv -o o",
    "identify newton": "simulate cart_pendulum_guess.toml -o r.csv"
    " ; identify cart_pendulum_guess.toml r.csv -o o --method newton",
    "identify two": "simulate cart_pendulum_guess.toml -o a.csv"
    " ; simulate cart_pendulum_guess.toml -o b.csv --seed 1"
    " ; identify cart_pendulum_guess.toml a.csv -o o --held-out b.csv --samples 3",
    "identify servo": "simulate servo_arm.toml -o r.csv ; identify servo_arm.toml r.csv -o o",
    "identify release": "simulate free_pendulum.toml -o r.csv"
    " ; identify free_pendulum.toml r.csv -o o",
    "identify double": "simulate double_pendulum.toml -o r.csv"
    " ; identify double_pendulum.toml r.csv -o o",
    "identify noise": "simulate cart_pendulum_guess.toml -o r.csv"
    " ; identify cart_pendulum_guess+fit.noise=estimate+fit.bootstrap=20 r.csv -o o",
    "closed loop": "simulate two_joint_arm+horizon=3.0+controllers.shoulder.kp=50.0"
    "+controllers.shoulder.kd=4.0+controllers.elbow.kp=30.0+controllers.elbow.kd=2.0"
    "+initial.control.kind=multisine+initial.control.amplitude=0.3 -o r.csv"
    " ; identify two_joint_arm+controllers.shoulder.kp=50.0+controllers.shoulder.kd=4.0"
    "+controllers.elbow.kp=30.0+controllers.elbow.kd=2.0 r.csv -o o",
    "select": "simulate double_pendulum.toml -o r.csv"
    " ; identify double_pendulum.toml r.csv -o o --select",
    "payload": "simulate payload/load.toml -o r.csv"
    " ; simulate payload/robot.toml -o w.csv"
    " ; payload payload/robot.toml r.csv --without w.csv --body hand -o o",
    # Measured data.
    "pendulum": "identify dfki_simple_pendulum.toml"
    " shared/data/dfki_simple_pendulum/dircol_measured.csv"
    " --held-out shared/data/dfki_simple_pendulum/energy_shaping_measured.csv -o o",
    "pendulum select": "identify dfki_simple_pendulum.toml"
    " shared/data/dfki_simple_pendulum/dircol_measured.csv --select -o o",
    "elbow": "identify dfki_double_pendulum.toml shared/data/dfki_double_pendulum/A0_00.csv.gz"
    " --held-out shared/data/dfki_double_pendulum/A0_01.csv.gz -o o",
    "servo": "identify bam_xl330.toml shared/data/bam_xl330/raw/2026-01-15_10h28m10.json"
    " --held-out shared/data/bam_xl330/raw/2026-01-15_10h28m24.json -o o",
    "check servo log": "check bam_xl330.toml"
    " shared/data/bam_xl330/raw/2026-01-15_10h28m10.json -o o",
    # Studies and exports.
    "compare": "compare cart_pendulum.toml -o o --seconds 3 --methods chirp,fourier5",
    "compare robots": "simulate cart_pendulum_guess.toml -o a.csv"
    " ; simulate cart_pendulum_guess+parameters.c.true=1.5 -o b.csv"
    " ; identify cart_pendulum_guess.toml a.csv -o a ; identify cart_pendulum_guess.toml b.csv -o b"
    " ; compare-robots a b -o o",
    "rehearse": "design cart_pendulum+descent.max_iterations=10 -o a"
    " ; rehearse a --experiment cart_pendulum.toml -o o --robots 10",
    "monte carlo": "design cart_pendulum+descent.max_iterations=10 -o a"
    " ; montecarlo cart_pendulum.toml a -o o --trials 20",
    "campaign": "campaign cart_pendulum_guess+descent.max_iterations=20 -o o --rounds 2"
    " --wanted 0.02",
    "exports": "design cart_pendulum+descent.max_iterations=5 -o a"
    " ; export a --to player -o o/player.py ; export a --to ros2 -o o/motion.yaml ; report a",
    # Wrong input: the exit code and the message count.
    "wrong key": "check cart_pendulum+cost.criterium=E -o o",
    "wrong path": "check cart_pendulum+parameters.m.target=body/nobody:mass -o o",
    "wrong unit": "check cart_pendulum+horizon='4~kg' -o o",
    "wrong log": "identify cart_pendulum.toml cart_pendulum.xml -o o",
    "no file": "design nothing.toml -o o",
    "foreign folder": "simulate cart_pendulum.toml -o o/design.json"
    " ; design cart_pendulum+descent.max_iterations=2 -o o",
}
