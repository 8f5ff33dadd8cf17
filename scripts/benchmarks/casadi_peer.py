"""Peer solvers of the benchmark: CasADi with IPOPT or L-BFGS on a hand-derived cart-pendulum.

Development only; the package `mjfim` never imports this file. Both peers use single shooting. The
unknowns are the N = 400 cart forces [N], held for 10 ms each, and every derivative is exact for the
discrete RK4 map.

    J(u) = Q_p / lambda_min(I) + dt/2 * sum_{k=0..N-1} [q (s_{k+1} - s^d_{k+1})^2 + R u_k^2]
    I    = dt / sigma^2 * sum_{k=1..N} psi_k' psi_k
    psi_{k+1} = F_x psi_k + F_theta,   psi_0 = 0

With a C compiler on the path, the functions are generated as C and built once per process. Without
one, they run in CasADi's virtual machine, slower but with equal results.

The peers are timed on one core. With several threads of OpenBLAS, L-BFGS can spend most of its time
in threads that wait for each other. This file therefore asks for one thread, which has an effect
only if it is imported before NumPy (or if the variable is set outside). `benchmark` runs it.
"""

from __future__ import annotations

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

# Number of control samples.
N = 400

# Sample period [s].
DT = 0.01

# Mass of the cart [kg].
CART_MASS = 1.0

# Gravity [m/s²].
GRAVITY = 9.81

# Standard deviation of the noise of each state [m, rad, m/s, rad/s].
SIGMA = 0.05

# Weight of the information term.
Q_P = 1.0

# Initial state, hanging at rest.
X0 = (0.0, np.pi, 0.0, 0.0)

# Numbers of states and of parameters.
NX, NP = 4, 3

# Number of entries of a state and of its three sensitivity columns.
NZ = NX * (1 + NP)

# Number of correction pairs of L-BFGS.
MEMORY = 40

# Places of the six entries of the information, which is symmetric: its upper triangle.
ENTRIES = tuple((i, j) for j in range(NP) for i in range(j + 1))


@dataclass(frozen=True)
class Case:
    """One row of the study.

    Attributes:
        name: Letter of the case.
        theta: Parameters m [kg], l [m] and c [N m s/rad].
        r_tau: Weight of the control [1/(N² s)].
        q_slide: Weight of the cart position [1/(m² s)].
    """

    name: str
    theta: tuple[float, float, float]
    r_tau: float
    q_slide: float


# True parameters of the study.
ACTUAL = (2.0, 1.0, 1.0)

# Rows of the study by their letters.
CASES = {
    "a": Case("a", ACTUAL, 6e-3, 0.0),
    "b": Case("b", ACTUAL, 1e-3, 0.05),
    "c": Case("c", ACTUAL, 1e-4, 0.0),
    "f": Case("f", ACTUAL, 1e-6, 0.0),
}


@dataclass(frozen=True)
class PeerRun:
    """Outcome of one run of a peer solver.

    Attributes:
        name: Name of the solver.
        case: Letter of the case.
        J: Cost of the solution.
        iterations: Number of iterations.
        seconds: Time of the solver alone [s].
        setup_seconds: Time for x_d and the solver object of this case [s].
        history: Time since the start of the solver [s] and lowest J up to then.
    """

    name: str
    case: str
    J: float
    iterations: int
    seconds: float
    setup_seconds: float
    history: tuple[tuple[float, float], ...]


def reference_control() -> Array:
    """Return the reference control u_ref (400,) [N]."""
    t = DT * np.arange(N)
    return np.asarray((1 + t / 4) * np.sin(2 * t), dtype=float)


def dynamics(x: ca.SX, u: ca.SX, theta: ca.SX) -> ca.SX:
    """Compute the derivative of the state by time, from the Lagrangian of the study.

    Args:
        x: State (s, phi, s', phi') with phi = 0 upright.
        u: Force on the cart.
        theta: Parameters (m, l, c).

    Returns:
        Derivative x'.
    """
    m, length, friction = ca.vertsplit(theta)
    _, phi, s_dot, phi_dot = ca.vertsplit(x)
    sin = ca.sin(phi)
    cos = ca.cos(phi)

    # (M + m) s'' - m l cos(phi) phi'' = force,   -m l cos(phi) s'' + m l^2 phi'' = torque
    force = u - m * length * phi_dot**2 * sin
    torque = m * GRAVITY * length * sin - friction * phi_dot

    s_ddot = (force + cos * torque / length) / (CART_MASS + m * sin**2)
    phi_ddot = (torque / (m * length) + cos * s_ddot) / length
    return ca.vertcat(s_dot, phi_dot, s_ddot, phi_ddot)


def rk4(x: ca.SX, u: ca.SX, theta: ca.SX) -> ca.SX:
    """Integrate the state over a sample under a held control.

    Args:
        x: State at the beginning.
        u: Force on the cart.
        theta: Parameters (m, l, c).

    Returns:
        State at the end.
    """
    k1 = dynamics(x, u, theta)
    k2 = dynamics(x + DT / 2 * k1, u, theta)
    k3 = dynamics(x + DT / 2 * k2, u, theta)
    k4 = dynamics(x + DT * k3, u, theta)
    return x + DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def information_rate(psi: ca.SX) -> ca.SX:
    """Compute the contribution of one sample to the six entries of I.

    Args:
        psi: (4, 3) sensitivity of the state.

    Returns:
        Six entries.
    """
    gram = DT / SIGMA**2 * psi.T @ psi
    entries = [gram[i, j] for i, j in ENTRIES]
    return ca.vertcat(*entries)


def smallest_eigenvalue(entries: ca.SX) -> ca.SX:
    """Compute the smallest eigenvalue of a symmetric 3x3 matrix in closed trigonometric form.

    The form is smooth where the smallest eigenvalue is simple.

    Args:
        entries: Six entries in the order of `ENTRIES`.

    Returns:
        The eigenvalue.
    """
    a = ca.SX(NP, NP)
    for value, (i, j) in zip(ca.vertsplit(entries), ENTRIES, strict=True):
        a[i, j] = value
        a[j, i] = value

    mean = ca.trace(a) / 3
    deviator = a - mean * ca.SX.eye(NP)
    radius = ca.sqrt(ca.sumsqr(deviator) / 6)
    angle = ca.acos(ca.det(deviator / radius) / 2) / 3
    return mean + 2 * radius * ca.cos(angle + 2 * np.pi / 3)


@dataclass(frozen=True)
class Stage:
    """Functions of one control sample; z holds a state and its sensitivity columns.

    Attributes:
        step: (z, u, theta) to z after the sample.
        linear: (z, u, theta) to A = dz+/dz and B = dz+/du.
        curvature: (z, u, theta, costate) to the blocks zz, zu and uu of the Hessian of the product
            of costate and z after the sample.
        rate: z to its contribution to I.
        rate_jacobian: z to the Jacobian of the contribution.
        rate_hessian: Weights of the six entries to the Hessian of the weighted contribution by z.
        criterion: I to Q_p / lambda_min, its gradient and its Hessian.
    """

    step: ca.Function
    linear: ca.Function
    curvature: ca.Function
    rate: ca.Function
    rate_jacobian: ca.Function
    rate_hessian: ca.Function
    criterion: ca.Function


@functools.cache
def stage() -> Stage:
    """Build the functions of one sample."""
    z = ca.SX.sym("z", NZ)
    u = ca.SX.sym("u")
    theta = ca.SX.sym("theta", NP)
    inputs = [z, u, theta]

    # State and sensitivity after the sample, and their derivatives.
    x = z[:NX]
    psi = ca.reshape(z[NX:], NX, NP)
    after = rk4(x, u, theta)
    psi_after = ca.jacobian(after, x) @ psi + ca.jacobian(after, theta)
    z_after = ca.vertcat(after, ca.vec(psi_after))
    slopes = [ca.jacobian(z_after, z), ca.jacobian(z_after, u)]

    costate = ca.SX.sym("costate", NZ)
    second = ca.hessian(ca.dot(costate, z_after), ca.vertcat(z, u))[0]
    blocks = [second[:NZ, :NZ], second[:NZ, NZ], second[NZ, NZ]]

    # Contribution of the sample to the information.
    rate = information_rate(psi)
    weights = ca.SX.sym("weights", 6)
    rate_hessian = ca.hessian(ca.dot(weights, rate), z)[0]

    # Criterion of the information.
    info = ca.SX.sym("info", 6)
    value = Q_P / smallest_eigenvalue(info)
    value_hessian, value_gradient = ca.hessian(value, info)

    return Stage(
        step=ca.Function("step", inputs, [z_after]),
        linear=ca.Function("linear", inputs, slopes),
        curvature=ca.Function("curvature", [*inputs, costate], blocks),
        rate=ca.Function("rate", [z], [rate]),
        rate_jacobian=ca.Function("rate_jacobian", [z], [ca.jacobian(rate, z)]),
        rate_hessian=ca.Function("rate_hessian", [weights], [rate_hessian]),
        criterion=ca.Function("criterion", [info], [value, value_gradient, value_hessian]),
    )


@dataclass(frozen=True)
class Rollout:
    """Symbols of the functions over all samples.

    Attributes:
        u: (N,) controls.
        p: Inputs theta, r_tau, q_slide and s^d at samples 1..N.
        z: (16, N) states and sensitivities after each sample.
        info: Six entries of I.
        objective: J.
    """

    u: ca.MX
    p: ca.MX
    z: ca.MX
    info: ca.MX
    objective: ca.MX


def start_of_sweep() -> ca.DM:
    """Return the initial state with sensitivities of zero: (16,)."""
    return ca.DM([*X0, *([0.0] * (NZ - NX))])


def rollout() -> Rollout:
    """Build the symbolic objective as a function of all controls."""
    u = ca.MX.sym("u", N)
    p = ca.MX.sym("p", NP + 2 + N)
    theta = p[:NP]
    control_weight = p[NP]
    slide_weight = p[NP + 1]
    planned_slide = p[NP + 2 :]

    parts = stage()
    z = parts.step.mapaccum(N)(start_of_sweep(), u.T, ca.repmat(theta, 1, N))
    info = ca.sum2(parts.rate.map(N)(z))

    slide_error = z[0, :].T - planned_slide
    squares = control_weight * ca.sumsqr(u) + slide_weight * ca.sumsqr(slide_error)
    running = DT / 2 * squares
    return Rollout(u=u, p=p, z=z, info=info, objective=parts.criterion(info)[0] + running)


@dataclass(frozen=True)
class Slopes:
    """First and second derivatives of a Lagrangian L(I, s_1..s_N, u).

    The Lagrangian is a sum over samples except for its dependence on I.

    Attributes:
        info: (6,) dL/dI.
        info_bend: (6, 6) d2L/dI2.
        slide: (samples,) dL/ds at samples 1..N.
        slide_bend: d2L/ds2, equal at all samples.
        control_bend: d2L/du2, equal at all samples.
    """

    info: ca.MX
    info_bend: ca.MX
    slide: ca.MX
    slide_bend: ca.MX
    control_bend: ca.MX


def slopes_of(roll: Rollout) -> Slopes:
    """Build the derivatives of J."""
    _, slope, bend = stage().criterion(roll.info)
    control_bend = DT * roll.p[NP]
    slide_bend = DT * roll.p[NP + 1]
    slide_error = roll.z[0, :].T - roll.p[NP + 2 :]

    return Slopes(
        info=slope,
        info_bend=bend,
        slide=slide_bend * slide_error,
        slide_bend=slide_bend,
        control_bend=control_bend,
    )


def condensed_hessian(u: ca.MX, theta: ca.MX, z: ca.MX, slopes: Slopes, parts: Stage) -> ca.MX:
    """Build the Hessian d2L/du2 by one backward sweep.

    The sweep carries, at each sample, the adjoints of the six information entries and of the slide
    cost, the curvature P of the cost to come, and the columns W = d2L/(dz du_j) of all later
    controls. Since 1/lambda_min is no sum over samples, its curvature enters at the end through
    dI/du.

    Args:
        u: (samples,) controls.
        theta: Parameters.
        z: (16, samples) states and sensitivities after each sample.
        slopes: Derivatives of the Lagrangian.
        parts: Functions of one sample.

    Returns:
        Upper triangle of the Hessian: (samples, samples).
    """
    samples = u.shape[0]
    before = ca.horzsplit(ca.horzcat(start_of_sweep(), z))
    slide = ca.DM.eye(NZ)[:, 0]
    rate_hessian = parts.rate_hessian(slopes.info)

    adjoint = ca.MX.zeros(NZ, 6)
    slide_adjoint = ca.MX.zeros(NZ)
    curve = ca.MX(NZ, NZ)
    columns = ca.MX(NZ, 0)
    rows = []
    info_slopes = []

    for k in reversed(range(samples)):
        # Add the terms of the state after the sample.
        adjoint += parts.rate_jacobian(before[k + 1]).T
        slide_adjoint += slide * slopes.slide[k]
        curve += rate_hessian + slopes.slide_bend * slide @ slide.T

        # Row of the Hessian.
        a, b = parts.linear(before[k], u[k], theta)
        costate = adjoint @ slopes.info + slide_adjoint
        h_zz, h_zu, h_uu = parts.curvature(before[k], u[k], theta, costate)
        curve_b = curve @ b
        diagonal = h_uu + slopes.control_bend + b.T @ curve_b
        rows.append(ca.horzcat(ca.MX(1, k), diagonal, b.T @ columns))
        info_slopes.append(b.T @ adjoint)

        # Pass to the state before the sample.
        columns = ca.horzcat(h_zu + a.T @ curve_b, a.T @ columns)
        curve = h_zz + a.T @ curve @ a
        adjoint = a.T @ adjoint
        slide_adjoint = a.T @ slide_adjoint

    info_by_u = ca.vertcat(*reversed(info_slopes))
    along_info = info_by_u @ slopes.info_bend @ info_by_u.T
    return ca.triu(ca.vertcat(*reversed(rows)) + along_info)


@dataclass(frozen=True)
class Problem:
    """Functions of (u, p) over all samples, ready to evaluate.

    Attributes:
        value: J and the entries of I.
        gradient: J and dJ/du.
        hessian: Multiplier of J times the upper triangle of d2J/du2, with the arguments of IPOPT.
        compiled: Whether the functions are compiled C.
        build_seconds: Time to build them [s].
    """

    value: ca.Function
    gradient: ca.Function
    hessian: ca.Function
    compiled: bool
    build_seconds: float


def compile_c(functions: list[ca.Function], folder: str) -> list[ca.Function]:
    """Compile functions to machine code.

    Args:
        functions: Functions of CasADi.
        folder: Folder for source and library, which must exist until the functions are loaded.

    Returns:
        Compiled functions in the order of the arguments.
    """
    generator = ca.CodeGenerator("peer.c")
    for function in functions:
        generator.add(function)
    source = generator.generate(folder + os.sep)
    library = os.path.join(folder, "peer.so")

    compiler = shutil.which(os.environ.get("CC", "gcc")) or "cc"
    options = ["-O3", "-march=native", "-fPIC", "-shared"]
    subprocess.run([compiler, *options, source, "-o", library], check=True)
    return [ca.external(function.name(), library) for function in functions]


@functools.cache
def problem(use_c: bool = True) -> Problem:
    """Build the functions once per process; without a C compiler `use_c` has no effect.

    Only the two large functions of one sample become C. The sweep of the Hessian around them
    consists of matrix products that CasADi's virtual machine runs as fast; unrolled over the
    horizon, it would take over a minute to compile.
    """
    begin = time.perf_counter()
    parts = stage()
    roll = rollout()

    variables = [roll.u, roll.p]
    slope = ca.gradient(roll.objective, roll.u)
    value = ca.Function("value", variables, [roll.objective, roll.info])
    gradient = ca.Function("gradient", variables, [roll.objective, slope])

    compiled = False
    if use_c:
        try:
            with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
                blocks = [value, gradient, parts.linear, parts.curvature]
                value, gradient, linear, curvature = compile_c(blocks, folder)
            parts = replace(parts, linear=linear, curvature=curvature)
            compiled = True
        except (OSError, subprocess.CalledProcessError) as error:
            message = f"casadi_peer: no C compiler ({error}); using CasADi's virtual machine"
            print(message, file=sys.stderr)

    # IPOPT also passes the multipliers of the constraints, which do not exist here.
    factor = ca.MX.sym("factor")
    no_constraints = ca.MX.sym("lam_g", 0)
    triangle = factor * condensed_hessian(roll.u, roll.p[:NP], roll.z, slopes_of(roll), parts)
    hessian = ca.Function("hessian", [*variables, factor, no_constraints], [triangle])

    return Problem(
        value=value,
        gradient=gradient,
        hessian=hessian,
        compiled=compiled,
        build_seconds=time.perf_counter() - begin,
    )


def parameters(case: Case) -> Array:
    """Compute the inputs p = (theta, r_tau, q_slide, s^d) of a case.

    The plan s^d [m] is the position of the cart under u_ref at the parameters of the case.
    """
    x = ca.SX.sym("x", NX)
    u = ca.SX.sym("u")
    theta = ca.SX.sym("theta", NP)
    step = ca.Function("plain_step", [x, u, theta], [rk4(x, u, theta)])

    control = ca.DM(reference_control()).T
    thetas = ca.repmat(ca.DM(case.theta), 1, N)
    states = step.mapaccum(N)(ca.DM(X0), control, thetas)
    return np.concatenate([case.theta, [case.r_tau, case.q_slide], states.full()[0]])


def objective(case: Case, u: Array, use_c: bool = True) -> tuple[float, Array]:
    """Evaluate a control.

    Args:
        case: Row of the study.
        u: (400,) control [N].
        use_c: Whether compiled functions are used.

    Returns:
        J and the eigenvalues of I, ascending.
    """
    j, entries = problem(use_c).value(u, parameters(case))

    info = np.empty((NP, NP))
    for value, (row, column) in zip(entries.full().ravel(), ENTRIES, strict=True):
        info[row, column] = value
        info[column, row] = value

    return float(j), np.asarray(np.linalg.eigvalsh(info), dtype=float)


class Recorder:
    """Clock and running minimum of J.

    Attributes:
        begin: Time at which the clock was started.
        history: Seconds since then and J, each lower than the values before.
    """

    def __init__(self) -> None:
        """Start the clock."""
        self.begin = time.perf_counter()
        self.history: list[tuple[float, float]] = []

    def seconds(self) -> float:
        """Return the time since the start."""
        return time.perf_counter() - self.begin

    def note(self, j: float) -> None:
        """Append J if it is lower than all values before."""
        if np.isfinite(j) and (not self.history or j < self.history[-1][1]):
            self.history.append((self.seconds(), j))


class IterateWatch(ca.Callback):
    """Iteration callback of IPOPT that records J of every accepted iterate."""

    def __init__(self) -> None:
        """Register with CasADi for a problem without constraints."""
        super().__init__()
        self.recorder = Recorder()
        self.rows = {"f": 1, "x": N, "lam_x": N, "lam_p": NP + 2 + N, "g": 0, "lam_g": 0}
        self.construct("iterate_watch", {})

    def get_n_in(self) -> int:
        """Return the number of outputs that the solver passes on."""
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
        """Record J and let the solver continue."""
        self.recorder.note(float(arg[ca.nlpsol_out().index("f")]))
        return [0]


def ipopt_solver(case: Case, functions: Problem, watch: IterateWatch) -> ca.Function:
    """Build IPOPT over the controls; J is scaled so that the weight of the control is one."""
    u = ca.MX.sym("u", N)
    p = ca.MX.sym("p", NP + 2 + N)
    options: dict[str, Any] = {
        "grad_f": functions.gradient,
        "hess_lag": functions.hessian,
        "iteration_callback": watch,
        "no_nlp_grad": True,
        "calc_lam_p": False,
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.max_iter": 500,
        "ipopt.tol": 1e-7,
        "ipopt.nlp_scaling_method": "none",
        "ipopt.obj_scaling_factor": 1 / (case.r_tau * DT),
    }
    problem_symbols: dict[str, Any] = {"x": u, "p": p, "f": functions.value(u, p)[0]}
    return ca.nlpsol("peer", "ipopt", problem_symbols, options)


def ipopt(case: Case, use_c: bool = True) -> PeerRun:
    """Solve by IPOPT from u_ref with the exact Hessian of single shooting."""
    functions = problem(use_c)

    setup = Recorder()
    p = parameters(case)
    watch = IterateWatch()
    solver = ipopt_solver(case, functions, watch)
    setup_seconds = setup.seconds()

    watch.recorder.begin = time.perf_counter()
    solution = solver(x0=reference_control(), p=p)
    seconds = watch.recorder.seconds()

    j, _ = objective(case, solution["x"].full().ravel(), use_c)
    return PeerRun(
        name="CasADi + IPOPT",
        case=case.name,
        J=j,
        iterations=int(solver.stats()["iter_count"]),
        seconds=seconds,
        setup_seconds=setup_seconds,
        history=tuple(watch.recorder.history),
    )


def lbfgs(case: Case, use_c: bool = True) -> PeerRun:
    """Solve by SciPy's L-BFGS-B from u_ref, on J / (R dt)."""
    functions = problem(use_c)

    setup = Recorder()
    p = parameters(case)
    scale = 1 / (case.r_tau * DT)
    options = {
        "maxcor": MEMORY,
        "maxiter": 2000,
        "maxfun": 4000,
        "ftol": 1e-12,
        "gtol": 1e-5,
    }
    setup_seconds = setup.seconds()

    recorder = Recorder()

    def scaled(u: Array) -> tuple[float, Array]:
        """Return scaled cost and gradient, and record the cost."""
        j, slope = functions.gradient(u, p)
        recorder.note(float(j))
        return scale * float(j), scale * slope.full().ravel()

    result = minimize(scaled, reference_control(), jac=True, method="L-BFGS-B", options=options)
    seconds = recorder.seconds()
    j, _ = objective(case, result.x, use_c)
    return PeerRun(
        name="CasADi + L-BFGS",
        case=case.name,
        J=j,
        iterations=int(result.nit),
        seconds=seconds,
        setup_seconds=setup_seconds,
        history=tuple(recorder.history),
    )
