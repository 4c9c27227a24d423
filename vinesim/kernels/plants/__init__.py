"""Articulated trees on ball joints with implicit springs: kinematics, prediction, impulse response, integration.

Featherstone's articulated-body recursion (Rigid Body Dynamics Algorithms, 2008, chapter 7), one thread a tree. The
springs enter the recursion implicitly: with theta the joint's rotation vector, w its rate and phi in [1/2, 1], the
torque over one step is about -K (theta + phi dt w_phi) - D w_phi, w_phi = w + phi dt dw/dt, so every joint inertia grows by
the *metric* phi dt (phi dt K + D) and stiffness cannot make the step unstable. phi = 1 is backward Euler (MuJoCo's
``discrete`` integrator), phi = 1/2 the trapezoidal rule.

K and D are diagonal in a joint's *middle axes*, turned from the joint's by half of its rotation, and the torque is the
gradient of theta^T K theta / 2 (:func:`vinesim.kernels.plants.forces.spring_torque`).

A step slows a mode of rate w by (w dt)^2 / 12. While nothing touches it, a tree whose first mode turns by more than
0.3 rad in a step takes substeps instead: ``tree_steps`` holds their number, :mod:`vinesim.kernels.plants.first_mode`
explains why. docs/decisions/integrator.md has the figures.

Loads lend stiffness, too: a force F drawing out a lever d resists turning with (d.F)(1 - dd^T / d.d). Taken explicitly
it gives a swing of rate w the damping ratio -(1 - phi) dt w / 2 (-0.018 for a bunch on 15 cm), and where a peduncle is
softer than what it carries it grows without bound. So it enters the inertia with phi^2 dt^2, and the force's moment is taken where
the lever will be (1 - phi) dt later: a swing then neither gains nor loses. F is weight, load and the last contacts.

This is one half of the stiffness that a load lends to a tree. The other half couples bending to twist: a force across a
lever turns with it, and so does the moment of a spring, with the middle of its joint (by half of what parent and body
turn). In equilibrium both together are symmetric. At phi 1/2, which must keep energy, they are included completely:
without them, a level cane loses 2 % of a sideways swing in a minute, and with 100 g on its tip it gains forty times its
energy in twenty seconds. Above phi 1/2 they are left out: they would cost a quarter of the step, and the scheme's own
damping outweighs them.

A body with parent -1 is a root. It hangs on its tree's pose, or *floats* if it has been cut off (``body_root`` names
the cut body with which a body moves, -1 for bodies that stand). A floating root has no spring and no lever. The inertia
that remains after its rotation is eliminated gives its linear acceleration: ``root_inverse_mass`` times the remaining
force. Where no tie holds it, it *falls* (``body_falls``): weight draws nothing out, and its momentum is corrected after
the step (``floating_components``). Components that hang from a tie are stepped like trees that stand.

Ties and air drag are forces at a point c of a body that grow against its velocity. Taken implicitly they look like a
mass W at c: W = phi dt (phi dt k + c) for a spring and damper, dt c for drag.

Gyroscopic and centrifugal terms stay explicit and err by about dt w^2 a second. A body turning faster than
``fast_rate`` is therefore held back by a drag dt (w^2 - fast_rate^2) times its momentum, and a tree with a joint beyond
``max_rate`` goes on at half of it.

Signs and frames: world axes; velocities and accelerations are (linear of the body's origin, angular), wrenches (force
at the origin, moment about it). The inertia of a body or subtree about the body's origin is held as three blocks,

    moment = J alpha + H a        force = H^T alpha + M a        with H = m [c]x for one body,

and after elimination of its joint a body keeps only D = (J + metric)^-1, D J and D H.

Bodies are numbered by their place in memory: the bodies of a tree are ``pitch`` apart, from ``tree_first`` on, children
after parents. Consecutive bodies (pitch 1) suit a CPU. A GPU reads neighbouring trees at once if their bodies are
neighbours in memory. Sums over children are read and stored, not added in place, which would be an atomic operation in
a GPU's far cache.

Files: ``structs`` (arguments), ``spatial`` (rotations, inertias), ``forces`` (springs, ties, drag), ``kinematics``,
``body_dynamics`` (one body and its joint), ``prediction`` (the three passes over one tree), ``eight_trees`` (the same
over eight trees at once, on a CPU), ``lean_prediction`` (the same with little memory traffic, on a GPU), ``first_mode``
(substeps), ``energy_budget``, ``impulse_response``, ``integration``, ``floating_components`` (cut-off parts),
``joint_wrench``, ``tree_checks``, ``gather_scatter`` (rows between host and device).
"""
