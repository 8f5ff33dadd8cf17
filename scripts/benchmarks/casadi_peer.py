"""Peer solvers for the benchmark: CasADi + IPOPT and CasADi + L-BFGS on a hand-derived
cart-pendulum.

Development only; the package `mjfim` never imports this file.  Both peers use single shooting: the
unknowns are the N = 400 cart forces [N], held for 10 ms each, and every derivative is exact for the
discrete RK4 map.

    J(u) = Q_p / lambda_min(I) + dt/2 * sum_{k=0..N-1} [q (s_{k+1} - s^d_{k+1})^2 + R u_k^2]
    I    = dt / sigma^2 * sum_{k=1..N} psi_k' psi_k,      psi_{k+1} = F_x psi_k + F_theta,   psi_0 =
    0

With a C compiler on the path the functions are generated as C and built once per process; without
one the same functions run in CasADi's virtual machine, slower but with equal results.  The peers
are timed on one core: L-BFGS can spend most of its time in threads that wait for each other if
OpenBLAS may use several, so this file asks for one thread, which only works if it is imported
before NumPy (or the variable is set outside).

Usage:  python -m scripts.benchmarks casadi_peer a c [--vm]
"""

from __future__ import annotations

import argparse
import functools
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

Array = NDArray[np.float64]

N = 400  # control samples
DT = 0.01  # s
CART_MASS = 1.0  # kg
GRAVITY = 9.81  # m/s^2
SIGMA = 0.05  # noise of each state: m, rad, m/s, rad/s
Q_P = 1.0
X0 = (0.0, np.pi, 0.0, 0.0)  # hanging at rest
NX, NP = 4, 3
NZ = NX * (1 + NP)  # state and its three sensitivity columns
MEMORY = 40  # correction pairs of L-BFGS
ENTRIES = tuple((i, j) for j in range(NP) for i in range(j + 1))  # upper triangle of I


@dataclass(frozen=True)
class Case:
    """One row of the study: theta = (m [kg], l [m], c [N m s/rad]) and the weights of the running
    cost.
    """

    name: str
    theta: tuple[float, float, float]
    r_tau: float  # 1/N^2 s
    q_slide: float  # 1/m^2 s, on the cart position only


ACTUAL, GUESS = (2.0, 1.0, 1.0), (2.5, 1.4, 1.4)
CASES = {
    case.name: case
    for case in (
        Case("a", ACTUAL, 6e-3, 0.0),
        Case("b", ACTUAL, 1e-3, 0.05),
        Case("c", ACTUAL, 1e-4, 0.0),
        Case("d", GUESS, 6e-3, 0.0),
        Case("e", GUESS, 1e-3, 0.05),
        Case("f", ACTUAL, 1e-6, 0.0),
    )
}


@dataclass(frozen=True)
class PeerRun:
    """Outcome of one solve; `history` holds (seconds since the solve began, lowest J so far)."""

    name: str
    case: str
    J: float
    eigenvalues: tuple[float, ...]  # of I, ascending
    iterations: int
    evaluations: int  # of J
    seconds: float  # solve only
    setup_seconds: float  # x_d and the solver object of this case
    build_seconds: (
        float  # differentiation, C generation and compilation; once per process, shared by all runs
    )
    history: tuple[tuple[float, float], ...]
    u: Array  # (400,) N
    compiled: bool
    converged: bool


def reference_control() -> Array:
    """Return u_ref (400,) [N]."""
    t = DT * np.arange(N)
    return np.asarray((1 + t / 4) * np.sin(2 * t), dtype=float)


def dynamics(x: ca.SX, u: ca.SX, theta: ca.SX) -> ca.SX:
    """Return x' for x = (s, phi, s', phi') with phi = 0 upright, from the Lagrangian of the study."""
    m, length, friction = ca.vertsplit(theta)
    _, phi, s_dot, phi_dot = ca.vertsplit(x)
    sin, cos = ca.sin(phi), ca.cos(phi)
    # (M + m) s'' - m l cos(phi) phi'' = force,   -m l cos(phi) s'' + m l^2 phi'' = torque
    force = u - m * length * phi_dot**2 * sin
    torque = m * GRAVITY * length * sin - friction * phi_dot
    s_ddot = (force + cos * torque / length) / (CART_MASS + m * sin**2)
    phi_ddot = (torque / (m * length) + cos * s_ddot) / length
    return ca.vertcat(s_dot, phi_dot, s_ddot, phi_ddot)


def rk4(x: ca.SX, u: ca.SX, theta: ca.SX, dt: float = DT) -> ca.SX:
    """Return the state `dt` [s] later under a held control."""
    k1 = dynamics(x, u, theta)
    k2 = dynamics(x + dt / 2 * k1, u, theta)
    k3 = dynamics(x + dt / 2 * k2, u, theta)
    k4 = dynamics(x + dt * k3, u, theta)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def information_rate(psi: ca.SX, dt: float = DT) -> ca.SX:
    """Return what one sample of `dt` [s] adds to the six entries of I."""
    gram = dt / SIGMA**2 * psi.T @ psi
    return ca.vertcat(*(gram[i, j] for i, j in ENTRIES))


def smallest_eigenvalue(entries: ca.SX) -> ca.SX:
    """Return lambda_min of the symmetric 3x3 matrix in closed trigonometric form; smooth while it
    is simple.
    """
    a = ca.SX(NP, NP)
    for value, (i, j) in zip(ca.vertsplit(entries), ENTRIES, strict=True):
        a[i, j] = a[j, i] = value
    mean = ca.trace(a) / 3
    deviator = a - mean * ca.SX.eye(NP)
    radius = ca.sqrt(ca.sumsqr(deviator) / 6)
    angle = ca.acos(ca.det(deviator / radius) / 2) / 3
    return mean + 2 * radius * ca.cos(angle + 2 * np.pi / 3)


@dataclass(frozen=True)
class Stage:
    """Scalar-graph building blocks of one control sample."""

    step: ca.Function  # (z, u, theta) -> z after the sample
    linear: ca.Function  # (z, u, theta) -> A = dz+/dz, B = dz+/du
    curvature: (
        ca.Function
    )  # (z, u, theta, costate) -> zz and zu blocks and uu entry of the costate-weighted Hessian
    rate: ca.Function  # z -> its addition to I
    rate_jacobian: ca.Function
    rate_hessian: ca.Function  # (entry weights) -> Hessian by z
    criterion: ca.Function  # I -> Q_p / lambda_min, gradient, Hessian


@functools.cache
def stage(dt: float = DT) -> Stage:
    """Build the blocks of one sample of `dt` [s]."""
    z, u, theta = ca.SX.sym("z", NZ), ca.SX.sym("u"), ca.SX.sym("theta", NP)
    x, psi = z[:NX], ca.reshape(z[NX:], NX, NP)
    after = rk4(x, u, theta, dt)
    psi_after = ca.jacobian(after, x) @ psi + ca.jacobian(after, theta)
    z_after = ca.vertcat(after, ca.vec(psi_after))
    costate = ca.SX.sym("costate", NZ)
    second = ca.hessian(ca.dot(costate, z_after), ca.vertcat(z, u))[0]
    rate, weights, info = information_rate(psi, dt), ca.SX.sym("weights", 6), ca.SX.sym("info", 6)
    value = Q_P / smallest_eigenvalue(info)
    value_hessian, value_gradient = ca.hessian(value, info)
    inputs = [z, u, theta]
    return Stage(
        step=ca.Function("step", inputs, [z_after]),
        linear=ca.Function("linear", inputs, [ca.jacobian(z_after, z), ca.jacobian(z_after, u)]),
        curvature=ca.Function(
            "curvature", [*inputs, costate], [second[:NZ, :NZ], second[:NZ, NZ], second[NZ, NZ]]
        ),
        rate=ca.Function("rate", [z], [rate]),
        rate_jacobian=ca.Function("rate_jacobian", [z], [ca.jacobian(rate, z)]),
        rate_hessian=ca.Function(
            "rate_hessian", [weights], [ca.hessian(ca.dot(weights, rate), z)[0]]
        ),
        criterion=ca.Function("criterion", [info], [value, value_gradient, value_hessian]),
    )


@dataclass(frozen=True)
class Rollout:
    """Symbols shared by the whole-horizon functions; p = (theta, r_tau, q_slide, s^d at samples
    1..N).
    """

    u: ca.MX
    p: ca.MX
    z: ca.MX  # (16, N) after each sample
    info: ca.MX
    objective: ca.MX


def rollout() -> Rollout:
    """Return the symbolic objective as a function of all controls."""
    u, p = ca.MX.sym("u", N), ca.MX.sym("p", NP + 2 + N)
    start = ca.DM([*X0, *([0.0] * (NZ - NX))])
    z = stage().step.mapaccum(N)(start, u.T, ca.repmat(p[:NP], 1, N))
    info = ca.sum2(stage().rate.map(N)(z))
    slide_error = z[0, :].T - p[NP + 2 :]
    running = DT / 2 * (p[NP] * ca.sumsqr(u) + p[NP + 1] * ca.sumsqr(slide_error))
    return Rollout(u, p, z, info, stage().criterion(info)[0] + running)


@dataclass(frozen=True)
class Slopes:
    """First and second derivatives of a Lagrangian L(I, s_1..s_N, u) that is a sum but for its
    dependence on I.
    """

    info: ca.MX  # (6,) dL/dI
    info_bend: ca.MX  # (6, 6) d2L/dI2
    slide: ca.MX  # (samples,) dL/ds at samples 1..N
    slide_bend: ca.MX  # d2L/ds2, alike at all samples
    control_bend: ca.MX  # d2L/du2, alike at all samples


def slopes_of(roll: Rollout) -> Slopes:
    """Return the derivatives of J."""
    _, slope, bend = stage().criterion(roll.info)
    r_dt, q_dt = DT * roll.p[NP], DT * roll.p[NP + 1]
    return Slopes(slope, bend, q_dt * (roll.z[0, :].T - roll.p[NP + 2 :]), q_dt, r_dt)


def condensed_hessian(u: ca.MX, theta: ca.MX, z: ca.MX, slopes: Slopes, parts: Stage) -> ca.MX:
    """Return the upper triangle of d2L/du2 by one backward sweep.

    The sweep carries, at each sample, the adjoints of the six information entries and of the slide
    cost, the curvature P of the cost to come, and the columns W = d2L/(dz du_j) of all later
    controls.  Since 1/lambda_min is no sum over samples, its own curvature enters at the end
    through dI/du.
    """
    samples, rate_hessian = u.shape[0], parts.rate_hessian(slopes.info)
    slide = ca.DM.eye(NZ)[:, 0]
    start = ca.DM([*X0, *([0.0] * (NZ - NX))])
    adjoint, p_slide, curve, columns = (
        ca.MX.zeros(NZ, 6),
        ca.MX.zeros(NZ),
        ca.MX(NZ, NZ),
        ca.MX(NZ, 0),
    )
    rows, info_slopes = [], []
    before = ca.horzsplit(ca.horzcat(start, z))
    for k in reversed(range(samples)):
        z_after = before[k + 1]
        adjoint += parts.rate_jacobian(z_after).T
        p_slide += slide * slopes.slide[k]
        curve += rate_hessian + slopes.slide_bend * slide @ slide.T
        a, b = parts.linear(before[k], u[k], theta)
        h_zz, h_zu, h_uu = parts.curvature(before[k], u[k], theta, adjoint @ slopes.info + p_slide)
        curve_b = curve @ b
        rows.append(
            ca.horzcat(ca.MX(1, k), h_uu + slopes.control_bend + b.T @ curve_b, b.T @ columns)
        )
        info_slopes.append(b.T @ adjoint)
        columns = ca.horzcat(h_zu + a.T @ curve_b, a.T @ columns)
        curve = h_zz + a.T @ curve @ a
        adjoint, p_slide = a.T @ adjoint, a.T @ p_slide
    info_by_u = ca.vertcat(*reversed(info_slopes))
    return ca.triu(ca.vertcat(*reversed(rows)) + info_by_u @ slopes.info_bend @ info_by_u.T)


@dataclass(frozen=True)
class Problem:
    """Whole-horizon functions of (u, p), ready to evaluate."""

    value: ca.Function  # J, entries of I
    gradient: ca.Function  # J, dJ/du
    hessian: (
        ca.Function
    )  # multiplier of J times the upper triangle of d2J/du2, in IPOPT's signature
    compiled: bool
    build_seconds: float


def compile_c(functions: list[ca.Function], folder: str) -> list[ca.Function]:
    """Return the same functions as machine code; `folder` must live until they are loaded."""
    generator = ca.CodeGenerator("peer.c")
    for function in functions:
        generator.add(function)
    source, library = generator.generate(folder + os.sep), os.path.join(folder, "peer.so")
    compiler = shutil.which(os.environ.get("CC", "gcc")) or "cc"
    subprocess.run(
        [compiler, "-O3", "-march=native", "-fPIC", "-shared", source, "-o", library], check=True
    )
    return [ca.external(function.name(), library) for function in functions]


@functools.cache
def problem(use_c: bool = True) -> Problem:
    """Build the functions once per process; without a working C compiler `use_c` has no effect.

    Only the two large stage blocks of the Hessian become C: the sweep around them is matrix
    products that CasADi's virtual machine runs as fast, and, unrolled over the horizon, compiling
    it would take over a minute.
    """
    begin, parts, roll = time.perf_counter(), stage(), rollout()
    variables = [roll.u, roll.p]
    value = ca.Function("value", variables, [roll.objective, roll.info])
    gradient = ca.Function(
        "gradient", variables, [roll.objective, ca.gradient(roll.objective, roll.u)]
    )
    compiled = False
    if use_c:
        try:
            with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
                blocks = [value, gradient, parts.linear, parts.curvature]
                value, gradient, linear, curvature = compile_c(blocks, folder)
            parts, compiled = replace(parts, linear=linear, curvature=curvature), True
        except (OSError, subprocess.CalledProcessError) as error:
            print(
                f"casadi_peer: no C compiler ({error}); using CasADi's virtual machine",
                file=sys.stderr,
            )
    factor, no_constraints = ca.MX.sym("factor"), ca.MX.sym("lam_g", 0)
    triangle = factor * condensed_hessian(roll.u, roll.p[:NP], roll.z, slopes_of(roll), parts)
    hessian = ca.Function("hessian", [*variables, factor, no_constraints], [triangle])
    return Problem(value, gradient, hessian, compiled, time.perf_counter() - begin)


def parameters(case: Case) -> Array:
    """Return p = (theta, r_tau, q_slide, s^d); s^d [m] is the cart under u_ref with the same theta."""
    x, u, theta = ca.SX.sym("x", NX), ca.SX.sym("u"), ca.SX.sym("theta", NP)
    step = ca.Function("plain_step", [x, u, theta], [rk4(x, u, theta)])
    states = step.mapaccum(N)(
        ca.DM(X0), ca.DM(reference_control()).T, ca.repmat(ca.DM(case.theta), 1, N)
    )
    return np.concatenate([case.theta, [case.r_tau, case.q_slide], states.full()[0]])


def objective(case: Case, u: Array, use_c: bool = True) -> tuple[float, Array]:
    """Return J and the eigenvalues of I, ascending, of any control (400,) [N]."""
    j, entries = problem(use_c).value(u, parameters(case))
    info = np.empty((NP, NP))
    for value, (row, column) in zip(entries.full().ravel(), ENTRIES, strict=True):
        info[row, column] = info[column, row] = value
    return float(j), np.asarray(np.linalg.eigvalsh(info), dtype=float)


class Recorder:
    """Clock and running minimum of J."""

    def __init__(self) -> None:
        """Start the clock."""
        self.begin = time.perf_counter()
        self.history: list[tuple[float, float]] = []

    def seconds(self) -> float:
        """Return the time since the start."""
        return time.perf_counter() - self.begin

    def note(self, j: float) -> None:
        """Append J if it is the lowest yet."""
        if np.isfinite(j) and (not self.history or j < self.history[-1][1]):
            self.history.append((self.seconds(), j))


class IterateWatch(ca.Callback):
    """IPOPT's iteration callback: notes J of every accepted iterate."""

    def __init__(
        self, unknowns: int = N, constraints: int = 0, parameters: int = NP + 2 + N
    ) -> None:
        """Register with CasADi for a problem of this size."""
        super().__init__()
        self.recorder = Recorder()
        self.rows = {"f": 1, "x": unknowns, "lam_x": unknowns, "lam_p": parameters}
        self.rows |= {"g": constraints, "lam_g": constraints}
        self.construct("iterate_watch", {})

    def get_n_in(self) -> int:
        """Return the number of solver outputs handed over."""
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        """Return the number of results: the stop flag."""
        return 1

    def get_name_in(self, i: int) -> str:
        """Return the name of solver output i."""
        return str(ca.nlpsol_out(i))

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Return the shape of solver output i."""
        return ca.Sparsity.dense(self.rows[ca.nlpsol_out(i)], 1)

    def eval(self, arg: Sequence[ca.DM]) -> list[int]:
        """Note J and let the solver go on."""
        self.recorder.note(float(arg[ca.nlpsol_out().index("f")]))
        return [0]


def ipopt_solver(
    case: Case, functions: Problem, watch: IterateWatch, max_iterations: int
) -> ca.Function:
    """Return IPOPT over the controls, with J scaled so that the input penalty has curvature one."""
    u, p = ca.MX.sym("u", N), ca.MX.sym("p", NP + 2 + N)
    options: dict[str, Any] = {
        "grad_f": functions.gradient,
        "hess_lag": functions.hessian,
        "iteration_callback": watch,
        "no_nlp_grad": True,
        "calc_lam_p": False,
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.max_iter": max_iterations,
        "ipopt.tol": 1e-7,
        "ipopt.nlp_scaling_method": "none",
        "ipopt.obj_scaling_factor": 1 / (case.r_tau * DT),
    }
    problem_symbols: dict[str, Any] = {"x": u, "p": p, "f": functions.value(u, p)[0]}
    return ca.nlpsol("peer", "ipopt", problem_symbols, options)


def ipopt(case: Case, use_c: bool = True, max_iterations: int = 500) -> PeerRun:
    """Solve by IPOPT from u_ref with the exact Hessian of single shooting."""
    functions, task = problem(use_c), Recorder()
    p, watch = parameters(case), IterateWatch()
    solver = ipopt_solver(case, functions, watch, max_iterations)
    setup_seconds, watch.recorder.begin = task.seconds(), time.perf_counter()
    solution = solver(x0=reference_control(), p=p)
    seconds, stats, u = watch.recorder.seconds(), solver.stats(), solution["x"].full().ravel()
    j, eigenvalues = objective(case, u, use_c)
    return PeerRun(
        name="CasADi + IPOPT",
        case=case.name,
        J=j,
        eigenvalues=tuple(map(float, eigenvalues)),
        iterations=int(stats["iter_count"]),
        evaluations=int(stats["n_call_nlp_f"]),
        seconds=seconds,
        setup_seconds=setup_seconds,
        build_seconds=functions.build_seconds,
        history=tuple(watch.recorder.history),
        u=u,
        compiled=functions.compiled,
        converged=bool(stats["success"]),
    )


def lbfgs(case: Case, use_c: bool = True, max_iterations: int = 2000) -> PeerRun:
    """Solve by SciPy's L-BFGS-B from u_ref, on J / (R dt)."""
    functions, task = problem(use_c), Recorder()
    p, scale = parameters(case), 1 / (case.r_tau * DT)
    options = {
        "maxcor": MEMORY,
        "maxiter": max_iterations,
        "maxfun": 2 * max_iterations,
        "ftol": 1e-12,
        "gtol": 1e-5,
    }
    setup_seconds, recorder = task.seconds(), Recorder()

    def scaled(u: Array) -> tuple[float, Array]:
        j, slope = functions.gradient(u, p)
        recorder.note(float(j))
        return scale * float(j), scale * slope.full().ravel()

    result = minimize(scaled, reference_control(), jac=True, method="L-BFGS-B", options=options)
    seconds = recorder.seconds()
    j, eigenvalues = objective(case, result.x, use_c)
    return PeerRun(
        name="CasADi + L-BFGS",
        case=case.name,
        J=j,
        eigenvalues=tuple(map(float, eigenvalues)),
        iterations=int(result.nit),
        evaluations=int(result.nfev),
        seconds=seconds,
        setup_seconds=setup_seconds,
        build_seconds=functions.build_seconds,
        history=tuple(recorder.history),
        u=result.x,
        compiled=functions.compiled,
        converged=bool(result.success),
    )


def main() -> None:
    """Print one line per peer and case."""
    parser = argparse.ArgumentParser(
        description="Solve cases of the cart-pendulum study with the peer solvers."
    )
    parser.add_argument("cases", nargs="+", choices=sorted(CASES))
    parser.add_argument(
        "--vm", action="store_true", help="do not compile, even where a C compiler exists"
    )
    arguments = parser.parse_args()
    use_c = not arguments.vm
    built = problem(use_c)
    print(
        f"built in {built.build_seconds:.1f} s, "
        f"{'compiled C' if built.compiled else 'virtual machine'}"
    )
    counts = f"{'iter':>4}  {'eval':>4}  {'task s':>7}  {'solve s':>7}"
    print(f"{'case':4}  {'solver':15}  {'J':>15}  {'lambda':>35}  {counts}")
    for name in arguments.cases:
        for solve in (ipopt, lbfgs):
            run = solve(CASES[name], use_c)
            spectrum = " ".join(f"{value:11.6g}" for value in run.eigenvalues)
            counts = (
                f"{run.iterations:4d}  {run.evaluations:4d}  {run.setup_seconds:7.3f}  "
                f"{run.seconds:7.3f}"
            )
            note = "" if run.converged else "  not converged"
            print(f"{name:4}  {run.name:15}  {run.J:15.9g}  {spectrum:>35}  {counts}{note}")
