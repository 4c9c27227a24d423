"""Parameters of the physics: one frozen value with the unit and the source of each number.

It stands beside the scene's file format because a scene may override it, in a table ``[physics]``; the package
``vinesim.interaction`` reads it. Times are in seconds and distances in metres, so all of them keep their meaning when
``dt``
changes. READ: from the source named; DERIVED: computed from others; TUNED: chosen by experiment with this solver;
GUESSED: nothing better is known.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Fraction = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
Capacity = Annotated[int, msgspec.Meta(ge=1, le=1024)]
"""Places for which memory is set aside at the start; that of contacts grows with the square, to 1 GB."""


class ParameterError(ValueError):
    """A physics parameter out of its range; one line with name, value and remedy."""


class PhysicsParameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All numbers of the physics that a user may want to change. Raises :class:`ParameterError` if one is out of
    range."""

    # ------------------------------------------------------------------ whole world
    dt: Positive = 0.01
    """[s] Duration of a step. TUNED: 100 Hz. Clients run their loop at this rate."""
    gravity: NotNegative = 9.81
    """[m/s^2] Downwards. READ: standard gravity, 9.80665, rounded. The rest shape of plants is computed with 9.81."""
    friction: Positive = 0.8
    """[1] Coulomb coefficient of every contact whose pair of materials ``data/materials`` does not list. GUESSED for
    rubber pads, plastic crates and berries alike."""
    sleep: bool = True
    """Whether plants that are at rest are put to sleep. Off: every plant that was woken stays awake."""

    # ------------------------------------------------------------------ articulation solver (plants)
    phi: Annotated[float, msgspec.Meta(ge=0.5, le=1.0)] = 0.55
    """[1] Implicitness of the integration: 1/2 trapezoidal, 1 backward Euler. TUNED."""
    fast_joint_rate: Positive = 5.0
    """[rad/s] A tree with a faster joint is integrated with phi = 1; a body that turns faster feels drag. TUNED."""
    max_joint_rate: Positive = 50.0
    """[rad/s] No joint is integrated faster than this. DERIVED: half a radian in a step of 10 ms."""
    fault_joint_rate: Positive = 5000.0
    """[rad/s] A tree with a joint that would turn faster is stopped and reported as faulty. TUNED."""
    contact_onset_duration: NotNegative = 0.03
    """[s] A tree is integrated with phi = 1 for so long after a contact with it began. TUNED."""
    stiff_tie_mass: Positive = 10.0
    """[kg] A tree whose tie has a larger stiffness * dt^2 is integrated with phi = 1. TUNED: with phi below 1 such a
    tie (1e5 N/m at 10 ms) rings and feeds energy into the cane."""
    max_held_bodies: Capacity = 16
    """Plant bodies that hands can hold at once."""
    max_hands_per_body: Capacity = 4
    """Hands that can hold one plant body at once."""

    # ------------------------------------------------------------------ sleep of plants
    sleep_rate: Positive = 0.05
    """[rad/s] Trees are looked at only while all their joints turn slower than this. TUNED: rounding turns joints of
    twigs that are tied to wires 50 m from the origin at up to 0.03."""
    sleep_duration: Positive = 0.5
    """[s] A tree whose joints have been slow for so long is looked at. DERIVED: longer than the turning point of any
    swing."""
    sleep_speed: Positive = 2e-3
    """[m/s] No point of a tree that falls asleep is faster than this. TUNED: 0.07 mm between two pictures."""
    sleep_distance: Positive = 2e-4
    """[m] No point of a tree that falls asleep is further than this from where it would rest. TUNED."""

    # ------------------------------------------------------------------ wind
    wind_radius: Positive = 4.0
    """[m] With robots or people in the world, wind is simulated on trees whose foot is nearer to one of them than this.
    DERIVED: gusts let nothing sleep, and a step has time for some hundred awake trees."""
    wind_wake_load: Positive = 0.05
    """[1] A sleeping tree wakes when the drag on it has changed by this share of its weight. TUNED."""
    wind_check_period: Positive = 0.32
    """[s] In this time all sleeping trees are checked once, an equal number in each step. TUNED."""

    # ------------------------------------------------------------------ level of detail of bunches
    detail_duration: Positive = 1.0
    """[s] Clusters of a bunch move for so long after the last actor has gone. TUNED."""
    detail_rate: Positive = 0.05
    """[rad/s] Clusters are at rest while all of a tree turn slower than this against their parents. TUNED."""
    detail_rest_duration: Positive = 0.25
    """[s] Clusters that have been at rest for so long are fused again. DERIVED: longer than their turning point."""

    # ------------------------------------------------------------------ detachment
    detachment_duration: Positive = 0.03
    """[s] A peduncle breaks when it has been overloaded for so long. GUESSED: the peak of one step is no pull."""
    cutting_strength: Positive = 13.16e6
    """[Pa] Force of a blade over the cross-section that it cuts. READ: canes of Okuzgozu, JKSUS 2024 36:103034."""

    # ------------------------------------------------------------------ contacts with plants
    contact_stiffness: Positive = 2e4
    """[N/m] Of a contact with a plant, normal and (as the anchor of friction) tangential, unless ``data/materials``
    lists the pair. GUESSED."""
    contact_damping_time: NotNegative = 0.02
    """[s] Damping of a contact divided by its stiffness. TUNED: two steps of 10 ms."""
    contact_margin: Positive = 0.002
    """[m] Contacts exist from this gap on, or from as far as the two can come together in one step. TUNED."""
    static_contact_margin: Positive = 0.0002
    """[m] Static geoms and other branches are in contact when a step brings them nearer than this. TUNED."""
    impact_speed: Positive = 0.3
    """[m/s] A contact that closes faster is an impact: its tree is integrated with phi = 1. TUNED."""
    max_separation_speed: Positive = 1.0
    """[m/s] Overlap is resolved at this speed at most. TUNED."""
    contact_capacity: Capacity = 1024
    """Contacts solved in one step; of more, the deepest are kept."""
    max_contacts_per_tree: Capacity = 64
    """Contacts that one tree can have at once."""
    max_static_geoms_per_tree: Capacity = 256
    """Static geoms that can be near one tree at once."""
    solver_sweeps: Count = 100
    """Largest number of Gauss-Seidel sweeps; with warm start and Newton steps, two to five are usual. TUNED."""
    solver_newton_steps: Annotated[int, msgspec.Meta(ge=0)] = 6
    """Newton steps of an island, one after each of its first sweeps; then one in ten sweeps follows. TUNED."""
    solver_newton_contacts: Annotated[int, msgspec.Meta(ge=0)] = 16
    """Islands in which plants couple more contacts take no Newton step, which costs the cube of their number."""
    solver_tolerance: Positive = 1e-6
    """[1] Sweeps end when none changes an impulse by more than this share of the largest. TUNED."""
    solver_constraint_steps: Count = 10
    """Most times that contacts are solved again because MuJoCo's constraints (supports, limits) change under the
    impulses of plants. DERIVED: with crates that fall beside canes none is needed in 7 steps of 10, more in 1 of 50."""
    solver_constraint_tolerance: Positive = 1e-3
    """[m/s] MuJoCo's velocities at the contacts with plants differ by less from those that the impulses were found
    with. TUNED."""

    # ------------------------------------------------------------------ free bunches
    bunch_rolling_arm: NotNegative = 0.004
    """[m] Arm of the rolling resistance of a free bunch. GUESSED: two berries on which it lies are 10 mm apart and give
    way. Without it a bunch of spheres keeps rolling."""
    bunch_contact_time: Positive = 0.02
    """[s] Time constant of a free bunch's contacts (MuJoCo's solref). TUNED: with a longer one it never comes to
    rest."""
    bunch_contact_damping_ratio: Positive = 3.0
    """[1] Damping ratio of the same. TUNED: with 1, a bunch that fell a metre into a crate leaves it at up to 110
    m/s."""
    bunch_pool_size: Capacity = 12
    """Free bodies that are kept ready for bunches; when all are taken, the world is compiled anew (some 10 ms)."""
    dormant_radius: Positive = 2.5
    """[m] A dormant free bunch gets its body when an actor is this near on the ground plan. DERIVED: seconds before an
    arm can reach it."""

    # ------------------------------------------------------------------ robots
    base_slip: Positive = 0.01
    """[m or rad] Offset of a robot's base at which its tracks give their full effort; further, they slip. TUNED."""
    remote_base_slip: Positive = 0.05
    """[m or rad] The same for the copy of a remote robot. TUNED."""
    base_damping_time: Positive = 0.05
    """[s] Damping of the base's servos divided by their stiffness. TUNED."""

    # ------------------------------------------------------------------ people
    hand_stiffness: Positive = 100.0
    """[N/m] Force of a hand in contact per offset from its controller. READ: CANOPIES D6.4, section 3.1.1."""
    hand_force: Positive = 100.0
    """[N] Largest force of a hand. READ: CANOPIES D6.4, section 3.1.1."""
    hand_torsional_stiffness: Positive = 10.0
    """[N m/rad] Moment of a hand in contact per angle from its controller. GUESSED."""
    hand_moment: Positive = 10.0
    """[N m] Largest moment of a hand. GUESSED: the most that a wrist can do."""
    hand_mass: Positive = 0.4
    """[kg] READ: 0.6 % of a person's mass (Winter, Biomechanics and Motor Control, 2009)."""
    hand_inertia: Positive = 0.02
    """[kg m^2] GUESSED: with a hand turns the forearm."""
    hand_contact_duration: Positive = 0.05
    """[s] A hand stays on its spring for so long after its last contact, so that a bounce does not free it. TUNED."""
    hand_return_time: Positive = 0.1
    """[s] Time constant with which a free hand returns to its controller. TUNED."""
    hand_return_speed: Positive = 1.5
    """[m/s] Largest speed of that return. TUNED."""
    max_body_speed: Positive = 5.0
    """[m/s] No part of a person pushes faster than this, whatever the trackers report. GUESSED."""
    teleport_distance: Positive = 0.5
    """[m] A person whose head moves further than this in a step was put elsewhere: it has no speed then. GUESSED."""
    grasp_distance: Positive = 0.03
    """[m] A closing hand grasps what its palm or its fingers are this near to. GUESSED."""
    grasp_duration: Positive = 0.2
    """[s] A hand that closed on nothing still grasps what comes into it for so long; then it is a fist. GUESSED."""
    haptic_period: Positive = 0.05
    """[s] A contact that goes on is reported to the controller at this period. GUESSED."""
    haptic_onset_amplitude: Fraction = 0.2
    """[1] Smallest amplitude at the onset of a contact: one that is surely felt. GUESSED."""
    haptic_min_amplitude: Fraction = 0.01
    """[1] Smaller amplitudes are not reported. GUESSED."""

    # ------------------------------------------------------------------ support of boxes and free bunches
    support_rest_duration: Positive = 0.5
    """[s] An object that has been still on its support for so long is at rest. DERIVED: as ``sleep_duration``."""
    support_move_speed: Positive = 0.01
    """[m/s] A box that is faster moves, even within its band. TUNED."""
    support_snap_distance: Positive = 0.5
    """[m] A copy further than this from its received pose is put there at once. GUESSED."""

    def __post_init__(self) -> None:
        """Check every number: msgspec does so only for values that were read from a file."""
        for field in msgspec.structs.fields(self):
            trouble = _trouble(field.type, getattr(self, field.name))
            if trouble:
                raise ParameterError(f"physics.{field.name} is {getattr(self, field.name)!r}; give {trouble}")
        if not self.fast_joint_rate <= self.max_joint_rate <= self.fault_joint_rate:
            raise ParameterError(
                f"physics.fast_joint_rate is {self.fast_joint_rate}, max_joint_rate {self.max_joint_rate}, "
                f"fault_joint_rate {self.fault_joint_rate} rad/s; give them in increasing order"
            )

    def steps(self, duration: float) -> int:
        """The number of steps that a duration [s] takes, to the nearest, at least 1."""
        return max(1, round(duration / self.dt))


def _trouble(annotation: Any, value: Any) -> str:
    """What should have been given instead of a value; empty if it is in its range."""
    kind = msgspec.inspect.type_info(annotation)
    if isinstance(kind, msgspec.inspect.BoolType):
        return "" if isinstance(value, bool) else "True or False"
    whole = isinstance(kind, msgspec.inspect.IntType)
    if isinstance(value, bool) or not isinstance(value, int if whole else int | float) or not math.isfinite(value):
        return "a whole number" if whole else "a finite number"
    assert isinstance(kind, msgspec.inspect.IntType | msgspec.inspect.FloatType)
    bounds = []
    if kind.gt is not None and not value > kind.gt:
        bounds.append(f"above {kind.gt:g}")
    if kind.ge is not None and not value >= kind.ge:
        bounds.append(f"of {kind.ge:g} or more")
    if kind.le is not None and not value <= kind.le:
        bounds.append(f"of {kind.le:g} or less")
    return f"a number {' and '.join(bounds)}" if bounds else ""
