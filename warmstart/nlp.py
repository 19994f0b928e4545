"""A nonlinear program made of many copies of a few small functions.

Each :class:`Block` is one SX function (a knot's dynamics, an interval's defects, ...) applied to
many index sets of the variables. Jacobian and Hessian of the Lagrangian are derived once per
block, evaluated by ``Function.map`` and scattered into the sparse matrices that IPOPT reads.
A single expression graph of the whole problem spends most of its time in the Hessian instead.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np


@dataclass(frozen=True)
class Block:
    """``fn(x_b, p) -> cost, rows`` on every row of ``index`` (instances, block variables)."""

    name: str
    index: np.ndarray
    data: np.ndarray
    """(instances, d) constants of each copy, appended to the parameters."""
    lower: np.ndarray
    """(instances, m) bounds of the rows."""
    upper: np.ndarray
    row_names: tuple[str, ...]
    value: ca.Function
    gradient: ca.Function | None
    """None where the block adds nothing to the cost."""
    jacobian: ca.Function
    hessian: ca.Function

    @property
    def rows(self) -> int:
        return len(self.row_names)


@dataclass(frozen=True)
class Result:
    """What IPOPT returned, in physical units."""

    x: np.ndarray
    multipliers: np.ndarray
    objective: float
    max_violation: float
    """Largest bound or row violation in the scaled units of the rows and variables."""
    status: str
    iterations: int
    solve_s: float
    """Wall time (s)."""
    cpu_s: float
    """Processor time of this process (s)."""
    success: bool
    worst: tuple[tuple[str, float], ...]
    """Row names with the largest violations, worst first."""


@dataclass
class Program:
    """Variables, blocks and parameters of one structured nonlinear program."""

    parameters: int = 0
    lower: list[float] = field(default_factory=list)
    upper: list[float] = field(default_factory=list)
    scale: list[float] = field(default_factory=list)
    blocks: list[Block] = field(default_factory=list)

    def variable(
        self, shape: Sequence[int], lower, upper, scale: float | np.ndarray = 1.0
    ) -> np.ndarray:
        """Adds variables with physical bounds; returns their indices in ``shape``.

        ``lower``, ``upper`` and ``scale`` broadcast to ``shape``; the solver sees
        variable / scale.
        """
        count = int(np.prod(shape))
        start = len(self.lower)
        for target, value in ((self.lower, lower), (self.upper, upper), (self.scale, scale)):
            target.extend(np.broadcast_to(value, shape).ravel().tolist())
        return np.arange(start, start + count).reshape(shape)

    def block(
        self,
        name: str,
        inputs: Sequence[np.ndarray],
        build: Callable[..., tuple[Any, Sequence[tuple[str, Any, Any, Any]]]],
        data: np.ndarray | None = None,
    ) -> None:
        """Adds copies of one small function.

        ``inputs``: index arrays (instances, n_i); ``build(*vectors, p)`` gets SX vectors in
        physical units and returns (cost, [(row name, expression, lower, upper), ...]) where
        bounds broadcast to (instances, size of the expression). ``p`` holds the program's
        parameters, then the copy's row of ``data`` (instances, d).
        """
        index = np.hstack([np.asarray(i).reshape(len(inputs[0]), -1) for i in inputs])
        instances = len(index)
        if instances == 0:
            return
        scale = np.asarray(self.scale)[index]
        if np.ptp(scale, axis=0).max() > 0:
            raise ValueError(f"block '{name}': copies have differently scaled variables")
        y = ca.SX.sym("y", index.shape[1])
        data = np.zeros((instances, 0)) if data is None else np.asarray(data, dtype=float)
        p = ca.SX.sym("p", max(self.parameters, 1) + data.shape[1])
        x = y * ca.DM(scale[0])
        widths = [np.asarray(i).size // instances for i in inputs]
        split = ca.vertsplit(x, np.cumsum([0, *widths]).tolist())
        cost, rows = build(*split, p)
        names, lower, upper, expressions = [], [], [], []
        for row, expression, low, high in rows:
            expression = ca.SX(expression)
            size = expression.numel()
            names += [row] if size == 1 else [f"{row}[{i}]" for i in range(size)]
            expressions.append(ca.reshape(expression, size, 1))
            for target, bound in ((lower, low), (upper, high)):
                bound = np.asarray(bound, dtype=float)
                if bound.ndim == 1 and len(bound) == instances and size == 1:
                    bound = bound[:, None]
                target.append(np.broadcast_to(bound, (instances, size)))
        g = ca.vertcat(*expressions) if expressions else ca.SX(0, 1)
        f = ca.SX(cost)
        lam_f, lam_g = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", g.numel())
        gradient = ca.densify(ca.gradient(f, y))
        costs = not gradient.is_zero()
        lagrangian = lam_f * f + ca.dot(lam_g, g)
        hessian = ca.triu(ca.hessian(lagrangian, y)[0])
        empty = np.zeros((instances, 0))
        self.blocks.append(
            Block(
                name=name,
                index=index,
                data=data,
                lower=np.hstack(lower) if lower else empty,
                upper=np.hstack(upper) if upper else empty,
                row_names=tuple(names),
                value=ca.Function("value", [y, p], [f, ca.densify(g)]),
                gradient=ca.Function("gradient", [y, p], [gradient]) if costs else None,
                jacobian=ca.Function("jacobian", [y, p], [ca.jacobian(g, y)]),
                hessian=ca.Function("hessian", [y, p, lam_f, lam_g], [hessian]),
            )
        )

    def row_bounds(self) -> tuple[np.ndarray, np.ndarray, list[str]]:
        """Lower and upper bounds and names of all rows, block by block, copy by copy."""
        lower = np.concatenate([b.lower.ravel() for b in self.blocks])
        upper = np.concatenate([b.upper.ravel() for b in self.blocks])
        names = [
            f"{b.name}.{row}@{k}"
            for b in self.blocks
            for k in range(len(b.index))
            for row in b.row_names
        ]
        return lower, upper, names

    def solver(self, options: dict | None = None) -> ca.Function:
        """An IPOPT solver (MUMPS, exact Hessian) with structured derivatives."""
        n = len(self.lower)
        rows = [len(b.index) * b.rows for b in self.blocks]
        m = sum(rows)
        x, p = ca.MX.sym("x", n), ca.MX.sym("p", max(self.parameters, 1))
        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", m)
        f, g, gradient, jac_nz, hess_nz = ca.MX(0), [], [], [], []
        gradient_of, jac_ij, hess_ij = [], [], []
        start = 0
        for b, count in zip(self.blocks, rows, strict=True):
            instances, width = b.index.shape
            x_b = ca.reshape(x[b.index.ravel().tolist()], width, instances)
            p_b = ca.vertcat(ca.repmat(p, 1, instances), ca.DM(b.data.T))
            costs, values = b.value.map(instances)(x_b, p_b)
            f += ca.sum2(costs)
            g.append(ca.vec(values))
            if b.gradient is not None:
                gradient.append(ca.vec(b.gradient.map(instances)(x_b, p_b)))
                gradient_of.append(b.index.ravel())
            row_of = start + np.arange(count).reshape(instances, b.rows)
            if b.rows:
                r, c = (np.array(v, dtype=int) for v in b.jacobian.sparsity_out(0).get_triplet())
                jac_ij.append((row_of[:, r].ravel(), b.index[:, c].ravel()))
                jac_nz.append(_nonzeros(b.jacobian.map(instances)(x_b, p_b)))
            lam_b = ca.reshape(lam_g[start : start + count], b.rows, instances)
            hess = b.hessian.map(instances)(x_b, p_b, lam_f, lam_b)
            r, c = (np.array(v, dtype=int) for v in b.hessian.sparsity_out(0).get_triplet())
            i, j = b.index[:, r].ravel(), b.index[:, c].ravel()
            hess_ij.append((np.minimum(i, j), np.maximum(i, j)))
            hess_nz.append(_nonzeros(hess))
            start += count
        g = ca.vertcat(*g)
        into = np.concatenate(gradient_of)
        grad = _scatter(ca.vertcat(*gradient), into, np.zeros_like(into), n, 1)
        i, j = map(np.concatenate, zip(*jac_ij, strict=True))
        jac = _scatter(ca.vertcat(*jac_nz), i, j, m, n)
        i, j = map(np.concatenate, zip(*hess_ij, strict=True))
        hess = _scatter(ca.vertcat(*hess_nz), i, j, n, n)
        settings = {
            "grad_f": ca.Function("nlp_grad_f", [x, p], [f, ca.densify(grad)]),
            "jac_g": ca.Function("nlp_jac_g", [x, p], [g, jac]),
            "hess_lag": ca.Function("nlp_hess_l", [x, p, lam_f, lam_g], [hess]),
            "print_time": False,
            "ipopt.sb": "yes",
            "ipopt.print_level": 0,
            "ipopt.linear_solver": "mumps",
            "ipopt.max_iter": 500,
            "ipopt.tol": 1e-4,
            "ipopt.constr_viol_tol": 1e-6,
            "ipopt.acceptable_tol": 1e-2,
            "ipopt.acceptable_constr_viol_tol": 1e-6,
            "ipopt.acceptable_dual_inf_tol": 1.0,
            "ipopt.acceptable_compl_inf_tol": 1e-3,
            "ipopt.acceptable_obj_change_tol": 1e-4,
            "ipopt.acceptable_iter": 8,
            "ipopt.mu_strategy": "adaptive",
            **(options or {}),
        }
        return ca.nlpsol("program", "ipopt", {"x": x, "p": p, "f": f, "g": g}, settings)

    def solve(
        self,
        solver: ca.Function,
        guess: np.ndarray,
        parameters: Sequence[float] = (),
        multipliers: np.ndarray | None = None,
    ) -> Result:
        """Solves from a guess in physical units; never raises on failure to converge."""
        scale = np.asarray(self.scale)
        lower, upper = np.asarray(self.lower) / scale, np.asarray(self.upper) / scale
        row_lower, row_upper, names = self.row_bounds()
        p = np.asarray(parameters, dtype=float) if len(parameters) else np.zeros(1)
        begin, cpu = time.perf_counter(), time.process_time()
        arguments = {
            "x0": np.clip(guess / scale, lower, upper),
            "p": p,
            "lbx": lower,
            "ubx": upper,
            "lbg": row_lower,
            "ubg": row_upper,
        }
        if multipliers is not None:
            arguments["lam_g0"] = multipliers
        out = solver(**arguments)
        elapsed, cpu = time.perf_counter() - begin, time.process_time() - cpu
        y, g = np.array(out["x"]).ravel(), np.array(out["g"]).ravel()
        row_error = np.maximum(np.maximum(row_lower - g, g - row_upper), 0.0)
        bound_error = np.maximum(np.maximum(lower - y, y - upper), 0.0)
        order = np.argsort(-row_error)[:8]
        stats = solver.stats()
        return Result(
            x=y * scale,
            multipliers=np.array(out["lam_g"]).ravel(),
            objective=float(out["f"]),
            max_violation=float(max(row_error.max(initial=0.0), bound_error.max(initial=0.0))),
            status=str(stats["return_status"]),
            iterations=int(stats["iter_count"]),
            solve_s=elapsed,
            cpu_s=cpu,
            success=bool(stats["success"]),
            worst=tuple((names[i], float(row_error[i])) for i in order if row_error[i] > 0),
        )


def _nonzeros(mapped: ca.MX) -> ca.MX:
    """Nonzeros of a horizontally mapped sparse matrix as a dense column, copy by copy."""
    return ca.vec(mapped.nz[:])


def _scatter(values: ca.MX, rows: np.ndarray, cols: np.ndarray, m: int, n: int) -> ca.MX:
    """Sparse m x n matrix whose entries are sums of ``values`` at (rows, cols)."""
    flat = cols.astype(np.int64) * m + rows
    unique, inverse = np.unique(flat, return_inverse=True)
    count, total = len(unique), len(flat)
    order = np.arange(total)
    add = ca.DM.triplet(inverse.tolist(), order.tolist(), ca.DM.ones(total), count, total)
    sparsity = ca.Sparsity.triplet(m, n, (unique % m).tolist(), (unique // m).tolist())
    return ca.MX(sparsity, ca.mtimes(add, values))
