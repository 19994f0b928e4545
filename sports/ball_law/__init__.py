"""The ball law: how tennis, table tennis and golf balls fly, bounce, roll and come to rest.

One source for every engine: the functions of ``flight``, ``contact``, ``play`` and ``shots`` are
compiled by numba for CPUs and by Warp for GPUs (``compiled``). Those of ``flight`` are smooth and
also take CasADi expressions, for trajectory optimisation. All are written in what every one of
these knows: floats, vectors made by ``vec`` and read by index, ``range``, variables that a loop
changes begun as ``float(...)`` or ``int(...)``.

Flight: gravity, quadratic drag, Magnus lift along w x v; Runge-Kutta of order 4 over what is left
of a substep. The spin stays as it is in the air.

Impact: the earliest contact with any surface is found by conservative advancement. The distance to
a convex surface is a convex function along a straight line, so along a path whose acceleration is
at most A it stays above ``gap + rate t - A t^2 / 2``: going to the root of that never passes a
contact, and converges as Newton's method does (Mirtich 1996, section 2.3, has the first-order
form). Tools move on the screw from their pose at the beginning of the substep to that at its end,
so windows join without a gap.

Impulses: Newton's restitution and Coulomb's friction as in Chatterjee and Ruina (1998, "A new
algebraic rigid-body collision law based on impulse space considerations"), which never adds
energy, whatever the inertia of the tool.

World frame, z up; m, kg, s, rad. Vectors (x, y, z), quaternions (w, x, y, z).
"""
