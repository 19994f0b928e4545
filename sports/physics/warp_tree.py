"""Equations of trees of bodies, solved for MuJoCo Warp's step without a matrix.

Three times in a substep MuJoCo solves ``(M + B) x = b`` with the joint-space inertia M: for the
acceleration without constraints (B = 0), for the integrator (B: the dampers' and servos' share of
the diagonal), and in each iteration of Newton's method (B = J^T D J: the constraints that push).
Here a block of threads takes a world and goes along its trees, a lane for each of the bodies that
are equally far from their root: the articulated-body algorithm (Featherstone, Rigid Body Dynamics
Algorithms, 2008, section 7.3) in MuJoCo's coordinates, about the centre of mass of a tree, in which
inertias and forces of a child are added to its parent's as they are. It takes O(n) operations,
where a Cholesky factor of the Hessian takes O(n^3) (165 degrees of freedom: 11 thousand
multiplications instead of 1.5 million).

What B holds of constraints:

* a joint's limit adds D to the joint's diagonal;
* a contact with something that does not move pushes one body along a wrench W for each edge of the
  friction pyramid, and D W W^T is added to that body's inertia;
* a contact of two bodies that both move couples them. Its rows j are solved apart: let the rest be
  L^T P L with pivots P, and u = L^-T j, which is zero but along the paths from both bodies to their
  roots; then (1/D + u^T P^-1 u) z = u^T P^-1 L^-T b, and what is left to solve has L^-T b - u z in
  the place of L^-T b (Woodbury's formula; the small matrix is well conditioned, as 1/D is a share
  of what it is added to). Of more than ``COUPLED`` such rows in a world, the others are put on both
  bodies' inertias with twice their D, which is no less than what they are: Newton's direction still
  descends.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco_warp._src import types

from sports.physics import warp_tree_code as code

COUPLED = 44
"""Rows of contacts between two bodies that move that a world solves exactly."""
AGAIN = 128
"""Threads of a block for Newton's direction, but in the first iteration: few of the worlds that
iterate on are not coupled, and what couples them has more to do side by side than a level of a
tree."""
CREW = 200
"""Degrees of freedom for each 32 threads of the first iteration, for which most worlds have little
to do."""

ROOM = 48 * 1024 - 512
"""Bytes of shared memory that a block may have, less what Warp itself takes."""

COLUMNS = ("body", "parent", "root", "dof", "dofs", "child", "children")
"""Of the table of bodies: the body's own number; its parent's row (-1: none); the root's number;
first degree of freedom and their number; first child's row and their number."""


@dataclass(frozen=True)
class Trees:
    """The trees of a model, on a Warp device."""

    table: wp.array
    """(B, 7) rows of ``COLUMNS`` of the bodies that move, those nearer to their root first,
    children of one parent side by side."""
    begin: wp.array
    """(L + 1,) first row of each level."""
    where: wp.array
    """(G,) row of the body of each geom; -1 where it does not move."""
    stops: wp.array
    """(B + 1,) where the path of each body begins in ``paths``."""
    paths: wp.array
    """Degrees of freedom from the root to a body, of one body after the other."""
    diagonal: wp.array
    """(nv,) where M keeps its diagonal."""
    each: wp.array
    """(nv,) all degrees of freedom."""
    above: wp.array
    """(nv,) parents of the degrees of freedom of trees of one body; -1 for the others."""
    bodies: int
    dofs: int
    lanes: int
    """Threads of a block: no fewer than the bodies of a level."""
    whole: bool
    """Newton's direction is found here too: all constraints are limits of joints and contacts with
    a pyramid for friction, and a block has room for it."""
    plain: bool
    """Nothing but the joints' own armature, damping and servos is on M's and the integrator's
    diagonals, nothing lifts bodies, and a block has room: all is solved here."""
    geared: list[Any]
    """Data that know the servos' moments, which never change."""
    scratch: wp.array
    """(N, nv COUPLED) where each world notes its coupled rows."""

    @property
    def levels(self) -> int:
        return self.begin.shape[0] - 1

    def solve(self, m: Any, d: Any, damped: wp.array, x: wp.array, y: wp.array) -> None:
        """``(M + B) x = y``, B the diagonal by which ``damped`` is more than ``d.M``."""
        lanes = block(self.lanes)
        wp.launch(
            _solve_kernel(self.bodies, self.dofs),
            dim=(d.nworld, lanes),
            inputs=[*self._inertias(m, d), self.diagonal, d.M, damped, y],
            outputs=[x],
            block_dim=lanes,
        )

    def multiply(self, m: Any, d: Any, y: wp.array, x: wp.array, skip: wp.array) -> None:
        """``y = M x`` in the worlds that do not ``skip``."""
        lanes = block(self.lanes)
        wp.launch(
            _multiply_kernel(self.bodies),
            dim=(d.nworld, lanes),
            inputs=[skip, *self._inertias(m, d), x],
            outputs=[y],
            block_dim=lanes,
        )

    def direction(self, m: Any, d: Any, ctx: Any, again: bool) -> None:
        """The gradient of the cost and Newton's direction; ``again``: after the step ``ctx.alpha``
        along the one before, and anew only in worlds in which a constraint's state has changed."""
        contact, rows = d.contact, d.efc
        lanes = block(max(self.lanes, AGAIN if again else 32 * -(-self.dofs // CREW)))
        wp.launch(
            _newton_kernel(self.bodies, self.dofs),
            dim=(d.nworld, lanes),
            inputs=[
                ctx.done,
                ctx.state_changed_count if again else d.nefc,
                again,
                ctx.alpha,
                *self._inertias(m, d),
                rows.Ma,
                d.qfrc_smooth,
                d.qfrc_constraint,
                self.where,
                self.stops,
                self.paths,
                d.subtree_com,
                d.nefc,
                d.njmax,
                rows.state,
                rows.type,
                rows.id,
                rows.D,
                rows.J_rowadr,
                rows.J_colind,
                rows.J,
                contact.geom,
                contact.pos,
                contact.frame,
                contact.friction,
                contact.efc_address,
            ],
            outputs=[
                self.scratch,
                ctx.grad,
                ctx.search,
                ctx.search_dot,
                ctx.newton_decrement,
                ctx.grad_dot,
                ctx.grad_scale,
                ctx.search_unchanged,
            ],
            block_dim=lanes,
        )

    def _inertias(self, m: Any, d: Any) -> list[Any]:
        return [self.table, self.begin, self.levels, d.cinert, d.cdof, m.dof_armature]


def block(lanes: int) -> int:
    """Threads of a block on Warp's current device: one on a CPU."""
    return lanes if wp.get_device().is_cuda else 1


def room(bodies: int, dofs: int, coupled: int = 0) -> int:
    """Bytes of shared memory that a world takes; two by two athletes with fingers 47972."""
    rows = coupled * (coupled + 1) // 2 + 5 * coupled + 4 if coupled else 0
    return 4 * (27 * bodies + 8 * dofs + rows)


def trees(model: mujoco.MjModel, num_worlds: int) -> Trees:
    """Of a model, on Warp's current device."""
    parent, depth = np.asarray(model.body_parentid), np.zeros(model.nbody, dtype=int)
    moving = np.asarray(model.body_treeid) >= 0
    for b in range(1, model.nbody):
        depth[b] = depth[parent[b]] + 1 if moving[parent[b]] else 0
    order: list[int] = []
    level = [b for b in range(1, model.nbody) if moving[b] and depth[b] == 0]
    begin = [0]
    while level:
        order += level
        begin.append(len(order))
        level = [c for b in level for c in range(b + 1, model.nbody) if parent[c] == b]
    row = np.full(model.nbody, -1)
    row[order] = np.arange(len(order))
    table = np.zeros((len(order), len(COLUMNS)), dtype=np.int32)
    for i, b in enumerate(order):
        children = [row[c] for c in order if parent[c] == b]
        table[i] = (
            b,
            row[parent[b]],
            model.body_rootid[b],
            max(model.body_dofadr[b], 0),
            model.body_dofnum[b],
            min(children, default=0),
            len(children),
        )
    paths: list[list[int]] = []
    for _, up, _, dof, dofs, _, _ in table.tolist():
        paths.append((paths[up] if up >= 0 else []) + list(range(dof, dof + dofs)))
    contacts_known = (
        model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
        and model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
        and {*np.asarray(model.geom_condim), *np.asarray(model.pair_dim)} <= {1, 3}
        and not (model.neq or model.ntendon or model.nflex)
        and not np.any(np.asarray(model.dof_frictionloss))
        and room(len(order), model.nv, COUPLED) <= ROOM
    )
    driven = np.asarray(model.jnt_type)[np.asarray(model.actuator_trnid)[:, 0]]
    members = np.bincount(np.asarray(model.body_treeid)[moving], minlength=model.ntree)
    alone = members[np.asarray(model.dof_treeid)] == 1
    width = int(np.diff(begin).max())
    return Trees(
        table=wp.array(table.reshape(-1), dtype=int),
        begin=wp.array(np.array(begin, dtype=np.int32), dtype=int),
        where=wp.array(row[np.asarray(model.geom_bodyid)].astype(np.int32), dtype=int),
        stops=wp.array(np.cumsum([0, *map(len, paths)]).astype(np.int32), dtype=int),
        paths=wp.array(np.array([k for path in paths for k in path], dtype=np.int32), dtype=int),
        diagonal=wp.array(
            (np.asarray(model.M_rowadr) + np.asarray(model.M_rownnz) - 1).astype(np.int32),
            dtype=int,
        ),
        each=wp.array(np.arange(model.nv, dtype=np.int32), dtype=int),
        above=wp.array(np.where(alone, model.dof_parentid, -1).astype(np.int32), dtype=int),
        bodies=len(order),
        dofs=model.nv,
        lanes=32 * -(-width // 32),
        whole=bool(contacts_known),
        plain=not (
            np.any(np.asarray(model.body_gravcomp))
            or model.opt.density
            or model.opt.viscosity
            or model.nflex
            or model.ntendon
            or np.any(np.asarray(model.actuator_armature))
            or np.any(np.asarray(model.actuator_trntype) != int(mujoco.mjtTrn.mjTRN_JOINT))
            or np.any(driven < int(mujoco.mjtJoint.mjJNT_SLIDE))
            or room(len(order), model.nv) > ROOM
        ),
        geared=[],
        scratch=wp.empty((num_worlds, model.nv * COUPLED if contacts_known else 0), dtype=float),
    )


@cache
def _solve_kernel(bodies: int, dofs: int) -> wp.Kernel:
    """``(M + B) x = y`` with a diagonal B, in every world."""

    @wp.func_native(snippet=code.solution(bodies, dofs))
    def solve_trees(
        w: int,
        lane: int,
        lanes: int,
        table: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        levels: int,
        inertia: wp.array2d(dtype=types.vec10),  # type: ignore[valid-type]
        axis: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
        armature: wp.array2d(dtype=float),  # type: ignore[valid-type]
        diagonal: wp.array(dtype=int),  # type: ignore[valid-type]
        bare: wp.array2d(dtype=float),  # type: ignore[valid-type]
        damped: wp.array2d(dtype=float),  # type: ignore[valid-type]
        right: wp.array2d(dtype=float),  # type: ignore[valid-type]
        solution: wp.array2d(dtype=float),  # type: ignore[valid-type]
    ): ...

    @wp.kernel(module="unique", enable_backward=False)
    def tree_solution(
        table: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        levels: int,
        inertia: wp.array2d(dtype=types.vec10),  # type: ignore[valid-type]
        axis: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
        armature: wp.array2d(dtype=float),  # type: ignore[valid-type]
        diagonal: wp.array(dtype=int),  # type: ignore[valid-type]
        bare: wp.array2d(dtype=float),  # type: ignore[valid-type]
        damped: wp.array2d(dtype=float),  # type: ignore[valid-type]
        right: wp.array2d(dtype=float),  # type: ignore[valid-type]
        solution: wp.array2d(dtype=float),  # type: ignore[valid-type]
    ):
        w, lane = wp.tid()
        lanes = wp.block_dim()
        solve_trees(
            w, lane, lanes, table, begin, levels, inertia, axis, armature, diagonal, bare, damped,
            right, solution,
        )  # fmt: skip

    return tree_solution


@cache
def _multiply_kernel(bodies: int) -> wp.Kernel:
    """``M x``; the length of ``skip`` may be 0."""

    @wp.func_native(snippet=code.product(bodies))
    def multiply_trees(
        w: int,
        lane: int,
        lanes: int,
        table: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        levels: int,
        inertia: wp.array2d(dtype=types.vec10),  # type: ignore[valid-type]
        axis: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
        armature: wp.array2d(dtype=float),  # type: ignore[valid-type]
        factor: wp.array2d(dtype=float),  # type: ignore[valid-type]
        product: wp.array2d(dtype=float),  # type: ignore[valid-type]
    ): ...

    @wp.kernel(module="unique", enable_backward=False)
    def tree_product(
        skip: wp.array(dtype=bool),  # type: ignore[valid-type]
        table: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        levels: int,
        inertia: wp.array2d(dtype=types.vec10),  # type: ignore[valid-type]
        axis: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
        armature: wp.array2d(dtype=float),  # type: ignore[valid-type]
        factor: wp.array2d(dtype=float),  # type: ignore[valid-type]
        product: wp.array2d(dtype=float),  # type: ignore[valid-type]
    ):
        w, lane = wp.tid()
        if skip.shape[0] > 0:
            if skip[w]:
                return
        lanes = wp.block_dim()
        multiply_trees(
            w, lane, lanes, table, begin, levels, inertia, axis, armature, factor, product
        )

    return tree_product


@cache
def _newton_kernel(bodies: int, dofs: int) -> wp.Kernel:
    """The gradient and Newton's direction in every world that is not done; ``again``: where
    something has ``changed``."""

    @wp.func_native(snippet=code.direction(bodies, dofs, COUPLED))
    def solve_trees(
        w: int,
        lane: int,
        lanes: int,
        table: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        levels: int,
        inertia: wp.array2d(dtype=types.vec10),  # type: ignore[valid-type]
        axis: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
        armature: wp.array2d(dtype=float),  # type: ignore[valid-type]
        moved: wp.array2d(dtype=float),  # type: ignore[valid-type]
        smooth: wp.array2d(dtype=float),  # type: ignore[valid-type]
        held: wp.array2d(dtype=float),  # type: ignore[valid-type]
        where: wp.array(dtype=int),  # type: ignore[valid-type]
        stops: wp.array(dtype=int),  # type: ignore[valid-type]
        paths: wp.array(dtype=int),  # type: ignore[valid-type]
        centre: wp.array2d(dtype=wp.vec3),  # type: ignore[valid-type]
        number: wp.array(dtype=int),  # type: ignore[valid-type]
        most: int,
        state: wp.array2d(dtype=int),  # type: ignore[valid-type]
        kind: wp.array2d(dtype=int),  # type: ignore[valid-type]
        id: wp.array2d(dtype=int),  # type: ignore[valid-type]
        mass: wp.array2d(dtype=float),  # type: ignore[valid-type]
        start: wp.array2d(dtype=int),  # type: ignore[valid-type]
        column: wp.array3d(dtype=int),  # type: ignore[valid-type]
        entries: wp.array3d(dtype=float),  # type: ignore[valid-type]
        pairs: wp.array(dtype=wp.vec2i),  # type: ignore[valid-type]
        points: wp.array(dtype=wp.vec3),  # type: ignore[valid-type]
        frames: wp.array(dtype=wp.mat33),  # type: ignore[valid-type]
        friction: wp.array(dtype=types.vec5),  # type: ignore[valid-type]
        address: wp.array2d(dtype=int),  # type: ignore[valid-type]
        scratch: wp.array2d(dtype=float),  # type: ignore[valid-type]
        gradient: wp.array2d(dtype=float),  # type: ignore[valid-type]
        solution: wp.array2d(dtype=float),  # type: ignore[valid-type]
        squares: wp.array(dtype=float),  # type: ignore[valid-type]
        decrements: wp.array(dtype=float),  # type: ignore[valid-type]
        steepnesses: wp.array(dtype=float),  # type: ignore[valid-type]
    ): ...

    @wp.kernel(module="unique", enable_backward=False)
    def newton_direction(
        done: wp.array(dtype=bool),  # type: ignore[valid-type]
        changed: wp.array(dtype=int),  # type: ignore[valid-type]
        again: bool,
        step: wp.array(dtype=float),  # type: ignore[valid-type]
        table: wp.array(dtype=int),  # type: ignore[valid-type]
        begin: wp.array(dtype=int),  # type: ignore[valid-type]
        levels: int,
        inertia: wp.array2d(dtype=types.vec10),  # type: ignore[valid-type]
        axis: wp.array2d(dtype=wp.spatial_vector),  # type: ignore[valid-type]
        armature: wp.array2d(dtype=float),  # type: ignore[valid-type]
        moved: wp.array2d(dtype=float),  # type: ignore[valid-type]
        smooth: wp.array2d(dtype=float),  # type: ignore[valid-type]
        held: wp.array2d(dtype=float),  # type: ignore[valid-type]
        where: wp.array(dtype=int),  # type: ignore[valid-type]
        stops: wp.array(dtype=int),  # type: ignore[valid-type]
        paths: wp.array(dtype=int),  # type: ignore[valid-type]
        centre: wp.array2d(dtype=wp.vec3),  # type: ignore[valid-type]
        number: wp.array(dtype=int),  # type: ignore[valid-type]
        most: int,
        state: wp.array2d(dtype=int),  # type: ignore[valid-type]
        kind: wp.array2d(dtype=int),  # type: ignore[valid-type]
        id: wp.array2d(dtype=int),  # type: ignore[valid-type]
        mass: wp.array2d(dtype=float),  # type: ignore[valid-type]
        start: wp.array2d(dtype=int),  # type: ignore[valid-type]
        column: wp.array3d(dtype=int),  # type: ignore[valid-type]
        entries: wp.array3d(dtype=float),  # type: ignore[valid-type]
        pairs: wp.array(dtype=wp.vec2i),  # type: ignore[valid-type]
        points: wp.array(dtype=wp.vec3),  # type: ignore[valid-type]
        frames: wp.array(dtype=wp.mat33),  # type: ignore[valid-type]
        friction: wp.array(dtype=types.vec5),  # type: ignore[valid-type]
        address: wp.array2d(dtype=int),  # type: ignore[valid-type]
        scratch: wp.array2d(dtype=float),  # type: ignore[valid-type]
        gradient: wp.array2d(dtype=float),  # type: ignore[valid-type]
        solution: wp.array2d(dtype=float),  # type: ignore[valid-type]
        squares: wp.array(dtype=float),  # type: ignore[valid-type]
        decrements: wp.array(dtype=float),  # type: ignore[valid-type]
        steepnesses: wp.array(dtype=float),  # type: ignore[valid-type]
        scales: wp.array(dtype=float),  # type: ignore[valid-type]
        unchanged: wp.array(dtype=bool),  # type: ignore[valid-type]
    ):
        w, lane = wp.tid()
        same = again and changed[w] == 0
        if lane == 0:
            unchanged[w] = same or (again and done[w])
        if done[w]:
            return
        if same:
            # The cost was a parabola along the whole step: the gradient is as it was but for its
            # length, of which the step took its share, and so is the direction.
            if lane == 0:
                scale = scales[w]
                left = scale - step[w]
                share = wp.where(scale != 0.0, left / scale, 0.0)
                decrements[w] = decrements[w] * share * share
                steepnesses[w] = steepnesses[w] * share * share
                scales[w] = left
            return
        if lane == 0:
            scales[w] = 1.0
        lanes = wp.block_dim()
        solve_trees(
            w, lane, lanes, table, begin, levels, inertia, axis, armature, moved, smooth, held,
            where, stops, paths, centre, number, most, state, kind, id, mass, start, column,
            entries, pairs, points, frames, friction, address, scratch, gradient, solution,
            squares, decrements, steepnesses,
        )  # fmt: skip

    return newton_direction
