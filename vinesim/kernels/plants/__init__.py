"""Articulated trees on ball joints with implicit springs: kinematics, prediction, impulse response, integration.

Featherstone's articulated-body recursion (Rigid Body Dynamics Algorithms, 2008, chapter 7), one thread a tree. The
springs enter the recursion implicitly: with theta the joint's rotation vector, w its rate and phi in [1/2, 1] the
implicitness of the integrator, the torque over one step is about -K (theta + phi dt w_phi) - D w_phi, w_phi = w + phi
dt dw/dt, so every joint inertia grows by the *metric* phi dt (phi dt K + D) and stiffness cannot make the step
unstable. phi = 1 is backward Euler (MuJoCo's ``discrete`` integrator), phi = 1/2 the trapezoidal rule.

K and D are diagonal in a joint's *middle axes*, turned from the joint's by half of its rotation, and the torque is the
gradient of theta^T K theta / 2 (:func:`vinesim.kernels.plants.forces.spring_torque`).

A step reduces the frequency w of a mode by the share (w dt)^2 / 12. So a tree without contacts takes substeps if its
first mode advances by more than 0.3 rad in a step. ``tree_steps`` holds the number of substeps,
:mod:`vinesim.kernels.plants.first_mode` explains it. docs/decisions/integrator.md has the figures.

Loads cause *geometric stiffness*: a force F that pulls along a lever d resists rotation with the stiffness (d.F)(1 -
dd^T / d.d). An explicit geometric stiffness would give a swing of frequency w the damping ratio -(1 - phi) dt w / 2
(-0.018 for a bunch on 15 cm). A swing would grow without bound where the peduncle's spring is weaker than this
stiffness. So the geometric stiffness enters the inertia with the factor phi^2 dt^2, and the force's moment is computed
with the lever's position (1 - phi) dt later. A swing then neither gains nor loses energy. F is the sum of weight, load
and the contact forces of the last step.

This is one half of the geometric stiffness. The other half couples bending to twist. It has two terms: a force across a
lever, whose moment changes when the lever turns, and the moment of a spring, which turns with the middle axes of its
joint (by half of the rotations of parent and body). In equilibrium the sum of the two terms is symmetric. At phi = 1/2,
where a step must conserve energy, both are included completely. Without them, a level cane loses 2 % of a sideways
swing in a minute, and with 100 g on its tip it gains forty times its energy in twenty seconds. Above phi = 1/2 they are
left out: they would take a quarter of the step's time, and the scheme's own damping is larger than their effect.

A body with parent -1 is a root. It is attached to its tree's fixed pose, or *floats* if it has been cut off.
``body_root`` of a body is the floating root whose component contains the body, or -1. A floating root has no spring and
no lever. Its linear acceleration is ``root_inverse_mass``, the inverse of the inertia that remains after its rotation
is eliminated, times the remaining force. A floating component that no tie holds *falls* (``body_falls``): its weight
causes no geometric stiffness, and its momentum is corrected after the step (``floating_components``). Components that
hang from a tie are integrated like trees with a fixed root.

Ties and air drag are forces at a point of a body that oppose its velocity. Implicitly they act like an added mass W at
this point: W = phi dt (phi dt k + c) for a spring of stiffness k with a damper c, and W = dt c for drag with the
coefficient c.

Gyroscopic and centrifugal terms are explicit; their relative error grows by about dt w^2 per second. So trees with a
body above 3 rad/s take steps of second order (``fast_motion``), unless contacts press on them. In all other trees a
drag of dt (w^2 - fast_rate^2) times its momentum slows a body that turns faster than ``fast_rate``, and the rates of a tree with a
joint beyond ``max_rate`` are scaled down until its fastest joint has half of ``max_rate``.

Signs and frames: all vectors are in world axes. Velocities and accelerations are (linear of the body's origin,
angular), wrenches are (force, moment about the body's origin). The inertia of a body or subtree about the body's origin
is stored as three blocks,

    moment = J alpha + H a        force = H^T alpha + M a        with H = m [c]x for one body,

and after elimination of its joint a body keeps only D = (J + metric)^-1, D J and D H.

Bodies are numbered by their place in memory: the bodies of a tree are ``pitch`` places apart, from ``tree_first`` on,
children after parents. Consecutive bodies (pitch 1) are fast on a CPU. A GPU reads several trees at once if bodies of
the same index in these trees are adjacent in memory. Sums over children are read, increased and stored, because an
addition in place would be an atomic operation in a distant cache of the GPU.

Files: ``structs`` (arguments), ``spatial`` (rotations, inertias), ``forces`` (springs, ties, drag), ``kinematics``,
``body_dynamics`` (one body and its joint), ``prediction`` (the three passes over one tree), ``eight_trees`` (the same
over eight trees at once, on a CPU), ``lean_prediction`` (the same with little memory traffic, on a GPU), ``first_mode``
(substeps), ``fast_motion``, ``energy_budget``, ``impulse_response``, ``integration``, ``floating_components`` (cut-off parts),
``joint_wrench``, ``tree_checks``, ``gather_scatter`` (rows between host and device).
"""
