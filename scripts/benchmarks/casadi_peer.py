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
from types import SimpleNamespace
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

# The initial state with sensitivities of zero: (16,).
START = ca.DM([*X0, *([0.0] * (NZ - NX))])


# True parameters of the study: m [kg], l [m] and c [N m s/rad].
ACTUAL = (2.0, 1.0, 1.0)

# Weights of the control [1/(N² s)] and of the cart position [1/(m² s)] by the letter of the case.
CASES = {"a": (6e-3, 0.0), "b": (1e-3, 0.05), "c": (1e-4, 0.0), "f": (1e-6, 0.0)}

Case = tuple[float, float]


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


@functools.cache
def stage() -> Any:
    """Functions of one control sample; z holds a state and its sensitivity columns.

    Returns:
        step: (z, u, theta) to z after the sample.
        linear: (z, u, theta) to A = dz+/dz and B = dz+/du.
        curvature: (z, u, theta, costate) to the blocks zz, zu and uu of the Hessian of the product
            of costate and z after the sample.
        rate: z to its contribution to I.
        rate_jacobian: z to the Jacobian of the contribution.
        rate_hessian: Weights of the six entries to the Hessian of the weighted contribution by z.
        criterion: I to Q_p / lambda_min, its gradient and its Hessian.
    """
    z = ca.SX.sym("z", NZ)
    u = ca.SX.sym("u")
    theta = ca.SX.sym("theta", NP)

    # State and sensitivity after the sample, and their derivatives.
    x = z[:NX]
    psi = ca.reshape(z[NX:], NX, NP)
    after = rk4(x, u, theta)
    psi_after = ca.jacobian(after, x) @ psi + ca.jacobian(after, theta)
    z_after = ca.vertcat(after, ca.vec(psi_after))

    costate = ca.SX.sym("costate", NZ)
    second = ca.hessian(ca.dot(costate, z_after), ca.vertcat(z, u))[0]

    # Contribution of the sample to the information.
    gram = DT / SIGMA**2 * psi.T @ psi
    rate = ca.vertcat(*(gram[i, j] for i, j in ENTRIES))
    weights = ca.SX.sym("weights", 6)

    # Criterion of the information.
    info = ca.SX.sym("info", 6)
    value = Q_P / smallest_eigenvalue(info)
    value_hessian, value_gradient = ca.hessian(value, info)

    inputs = [z, u, theta]
    slopes = [ca.jacobian(z_after, z), ca.jacobian(z_after, u)]
    blocks = [second[:NZ, :NZ], second[:NZ, NZ], second[NZ, NZ]]
    functions = {
        "step": (inputs, [z_after]),
        "linear": (inputs, slopes),
        "curvature": ([*inputs, costate], blocks),
        "rate": ([z], [rate]),
        "rate_jacobian": ([z], [ca.jacobian(rate, z)]),
        "rate_hessian": ([weights], [ca.hessian(ca.dot(weights, rate), z)[0]]),
        "criterion": ([info], [value, value_gradient, value_hessian]),
    }
    return SimpleNamespace(**{key: ca.Function(key, *each) for key, each in functions.items()})


def condensed_hessian(u: ca.MX, p: ca.MX, z: ca.MX, info: ca.MX, parts: Any) -> Any:
    """Build the Hessian d2J/du2 by one backward sweep.

    The sweep carries, at each sample, the adjoints of the six information entries and of the slide
    cost, the curvature P of the cost to come, and the columns W = d2J/(dz du_j) of all later
    controls. Since 1/lambda_min is no sum over samples, its curvature enters at the end through
    dI/du.

    Args:
        u: (N,) controls.
        p: Inputs of `problem`.
        z: (16, N) states and sensitivities after each sample.
        info: Six entries of I.
        parts: Functions of one sample.

    Returns:
        Upper triangle of the Hessian: (N, N).
    """
    theta, control_bend, slide_bend = p[:NP], DT * p[NP], DT * p[NP + 1]
    slide_slope = slide_bend * (z[0, :].T - p[NP + 2 :])
    _, info_slope, info_bend = parts.criterion(info)
    before = ca.horzsplit(ca.horzcat(START, z))
    slide = ca.DM.eye(NZ)[:, 0]
    rate_hessian = parts.rate_hessian(info_slope)

    adjoint = ca.MX.zeros(NZ, 6)
    slide_adjoint = ca.MX.zeros(NZ)
    curve = ca.MX(NZ, NZ)
    columns = ca.MX(NZ, 0)
    rows = []
    info_slopes = []

    for k in reversed(range(N)):
        # Add the terms of the state after the sample.
        adjoint += parts.rate_jacobian(before[k + 1]).T
        slide_adjoint += slide * slide_slope[k]
        curve += rate_hessian + slide_bend * slide @ slide.T

        # Row of the Hessian.
        a, b = parts.linear(before[k], u[k], theta)
        costate = adjoint @ info_slope + slide_adjoint
        h_zz, h_zu, h_uu = parts.curvature(before[k], u[k], theta, costate)
        curve_b = curve @ b
        diagonal = h_uu + control_bend + b.T @ curve_b
        rows.append(ca.horzcat(ca.MX(1, k), diagonal, b.T @ columns))
        info_slopes.append(b.T @ adjoint)

        # Pass to the state before the sample.
        columns = ca.horzcat(h_zu + a.T @ curve_b, a.T @ columns)
        curve = h_zz + a.T @ curve @ a
        adjoint = a.T @ adjoint
        slide_adjoint = a.T @ slide_adjoint

    info_by_u = ca.vertcat(*reversed(info_slopes))
    return ca.triu(ca.vertcat(*reversed(rows)) + info_by_u @ info_bend @ info_by_u.T)


@functools.cache
def problem(use_c: bool = True) -> Any:
    """Build functions over all samples once per process; without a C compiler `use_c` is ignored.

    Only the two large functions of one sample become C. The sweep of the Hessian around them
    consists of matrix products that CasADi's virtual machine runs as fast; unrolled over the
    horizon, it would take over a minute to compile.

    Returns:
        value: J and the entries of I by the controls u: (N,) and the inputs p: theta, r_tau,
            q_slide and s^d at samples 1..N.
        gradient: J and dJ/du.
        hessian: Multiplier of J times the upper triangle of d2J/du2, with the arguments of IPOPT.
        compiled: Whether the functions are compiled C.
        build_seconds: Time to build them [s].
    """
    begin = time.perf_counter()
    parts = SimpleNamespace(**vars(stage()))
    u = ca.MX.sym("u", N)
    p = ca.MX.sym("p", NP + 2 + N)
    z = parts.step.mapaccum(N)(START, u.T, ca.repmat(p[:NP], 1, N))
    info = ca.sum2(parts.rate.map(N)(z))
    slide_error = z[0, :].T - p[NP + 2 :]
    squares = p[NP] * ca.sumsqr(u) + p[NP + 1] * ca.sumsqr(slide_error)
    J = parts.criterion(info)[0] + DT / 2 * squares
    value = ca.Function("value", [u, p], [J, info])
    gradient = ca.Function("gradient", [u, p], [J, ca.gradient(J, u)])

    compiled = False
    if use_c:
        try:
            blocks = [value, gradient, parts.linear, parts.curvature]
            generator = ca.CodeGenerator("peer.c")
            for function in blocks:
                generator.add(function)
            command = [shutil.which(os.environ.get("CC", "gcc")) or "cc"]
            command += ["-O3", "-march=native", "-fPIC", "-shared"]
            with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
                library = os.path.join(folder, "peer.so")
                source = generator.generate(folder + os.sep)
                subprocess.run([*command, source, "-o", library], check=True)
                blocks = [ca.external(function.name(), library) for function in blocks]
            value, gradient, parts.linear, parts.curvature = blocks
            compiled = True
        except (OSError, subprocess.CalledProcessError) as error:
            message = f"casadi_peer: no C compiler ({error}); using CasADi's virtual machine"
            print(message, file=sys.stderr)

    # IPOPT also passes the multipliers of the constraints, which do not exist here.
    factor = ca.MX.sym("factor")
    no_constraints = ca.MX.sym("lam_g", 0)
    triangle = factor * condensed_hessian(u, p, z, info, parts)
    return SimpleNamespace(
        value=value,
        gradient=gradient,
        hessian=ca.Function("hessian", [u, p, factor, no_constraints], [triangle]),
        compiled=compiled,
        build_seconds=time.perf_counter() - begin,
    )


def parameters(case: Case) -> Array:
    """Compute the inputs p = (theta, r_tau, q_slide, s^d) of a case.

    The plan s^d [m] is the position of the cart under u_ref.
    """
    control = ca.DM(reference_control()).T
    states = stage().step.mapaccum(N)(START, control, ca.repmat(ca.DM(ACTUAL), 1, N))
    return np.concatenate([ACTUAL, case, states.full()[0]])


def objective(case: Case, u: Array, use_c: bool = True) -> tuple[float, Array]:
    """J and the eigenvalues of I, ascending, of a control u: (400,) [N]."""
    j, entries = problem(use_c).value(u, parameters(case))
    info = np.empty((NP, NP))
    for value, (row, column) in zip(entries.full().ravel(), ENTRIES, strict=True):
        info[row, column] = info[column, row] = value
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
    """Iteration callback of IPOPT that records J of every accepted iterate.

    Its inputs are the results of CasADi's solver: x, f, g, lam_x, lam_g and lam_p.
    """

    def __init__(self) -> None:
        """Register with CasADi for a problem without constraints."""
        super().__init__()
        self.recorder = Recorder()
        self.rows = (N, 1, 0, N, 0, NP + 2 + N)
        self.construct("iterate_watch", {})

    def get_n_in(self) -> int:
        return len(self.rows)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self.rows[i], 1)

    def eval(self, arg: Sequence[ca.DM]) -> list[int]:
        """Record J and let the solver continue."""
        self.recorder.note(float(arg[1]))
        return [0]


def outcome(case: Case, u: Array, use_c: bool, recorder: Recorder, **found: Any) -> Any:
    """The outcome of a solver at its end.

    Returns:
        J: Cost of the solution.
        history: Time since the start of the solver [s] and lowest J up to then.
        seconds: Time of the solver alone [s].
        The values of `found`: name of the solver, number of iterations, and time before the first
            iterate [s].
    """
    seconds = recorder.seconds()
    J, _ = objective(case, u, use_c)
    return SimpleNamespace(J=J, seconds=seconds, history=recorder.history, **found)


def ipopt(case: Case, use_c: bool = True) -> Any:
    """Solve by IPOPT from u_ref with the exact Hessian of single shooting.

    J is scaled so that the weight of the control is one.
    """
    functions = problem(use_c)

    setup = Recorder()
    start = parameters(case)
    watch = IterateWatch()
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
        "ipopt.obj_scaling_factor": 1 / (case[0] * DT),
    }
    symbols: dict[str, Any] = {"x": u, "p": p, "f": functions.value(u, p)[0]}
    solver = ca.nlpsol("peer", "ipopt", symbols, options)
    prepared = setup.seconds()

    watch.recorder.begin = time.perf_counter()
    solution = solver(x0=reference_control(), p=start)
    return outcome(
        case,
        solution["x"].full().ravel(),
        use_c,
        watch.recorder,
        name="CasADi + IPOPT",
        iterations=int(solver.stats()["iter_count"]),
        prepared=prepared,
    )


def lbfgs(case: Case, use_c: bool = True) -> Any:
    """Solve by SciPy's L-BFGS-B from u_ref, on J / (R dt)."""
    functions = problem(use_c)

    setup = Recorder()
    p = parameters(case)
    scale = 1 / (case[0] * DT)
    prepared = setup.seconds()

    recorder = Recorder()

    def scaled(u: Array) -> tuple[float, Array]:
        """Return scaled cost and gradient, and record the cost."""
        j, slope = functions.gradient(u, p)
        recorder.note(float(j))
        return scale * float(j), scale * slope.full().ravel()

    options = {"maxcor": MEMORY, "maxiter": 2000, "maxfun": 4000, "ftol": 1e-12, "gtol": 1e-5}
    result = minimize(scaled, reference_control(), jac=True, method="L-BFGS-B", options=options)
    name, iterations = "CasADi + L-BFGS", int(result.nit)
    found = {"name": name, "iterations": iterations, "prepared": prepared}
    return outcome(case, result.x, use_c, recorder, **found)
