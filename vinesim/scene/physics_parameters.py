"""Parameters of the physics: one frozen struct with the unit and the source of each number.

The struct is in this package because a scene may override its numbers in a table ``[physics]``. Times are in seconds
and distances in metres, so their meaning does not change with ``dt``. Grades of numbers: READ from the named source;
DERIVED from other numbers; TUNED by experiment with this solver; GUESSED because nothing better is known.

Plants consist of *trees*: kinematic trees of rigid bodies on elastic ball joints, such as a cane with its bunches.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Fraction = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
Capacity = Annotated[int, msgspec.Meta(ge=1, le=1024)]
"""Capacity of an array allocated at the start. Memory for contacts grows with its square, to 1 GB at 1024."""


class ParameterError(ValueError):
    """Raised for a physics parameter out of its range. The message is one line with name, value and valid range."""


class PhysicsParameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All numbers of the physics that a user may want to change.

    Raises :class:`ParameterError` if one is out of range.
    """

    # ------------------------------------------------------------------ whole world
    dt: Positive = 0.01
    """[s] Duration of a step. TUNED: 100 Hz. Clients run their loop at this rate."""
    gravity: NotNegative = 9.81
    """[m/s^2] Gravity, downwards. READ: standard gravity, 9.80665, rounded. Rest shapes of plants always use 9.81."""
    friction: Positive = 0.8
    """[1] Coulomb coefficient of every contact whose pair of materials ``data/materials`` does not list. GUESSED for
    rubber pads, plastic crates and berries alike."""
    sleep: bool = True
    """Whether trees (of plants) that are at rest fall asleep, so that steps do not integrate them until something
    touches them. If not, every tree that was woken stays awake."""

    # ------------------------------------------------------------------ articulation solver (plants)
    phi: Annotated[float, msgspec.Meta(ge=0.5, le=1.0)] = 0.55
    """[1] Implicitness of the integrator of plants (the theta of the theta method): 0.5 trapezoidal rule, which adds no
    damping, to 1 backward Euler. TUNED."""
    fast_joint_rate: Positive = 5.0
    """[rad/s] A tree with a joint faster than this is integrated with backward Euler (:attr:`phi` = 1). A body that
    turns faster than this is slowed by a drag, unless its tree takes steps for fast motion. TUNED."""
    max_joint_rate: Positive = 50.0
    """[rad/s] Limit of the rates of plants' joints. DERIVED: half a radian in a step of 10 ms."""
    fault_joint_rate: Positive = 5000.0
    """[rad/s] A tree with a joint that would turn faster than this is stopped and reported as faulty. TUNED."""
    contact_onset_duration: NotNegative = 0.03
    """[s] A tree is integrated with backward Euler (:attr:`phi` = 1) for this time after one of its contacts began.
    TUNED."""
    stiff_tie_mass: Positive = 10.0
    """[kg] A tree is integrated with backward Euler (:attr:`phi` = 1) if one of its ties (springs that hold a cane to a
    wire or a fixed point) has a larger stiffness * dt^2 than this. TUNED: with phi below 1 such a tie (1e5 N/m at 10
    ms) oscillates and feeds energy into the cane."""
    max_held_bodies: Capacity = 16
    """Largest number of plant bodies that hands hold at once."""
    max_hands_per_body: Capacity = 4
    """Largest number of hands that hold one plant body at once."""

    # ------------------------------------------------------------------ sleep of plants
    sleep_rate: Positive = 0.05
    """[rad/s] A tree is tested for sleep only while all its joints turn slower than this. TUNED: rounding errors turn
    joints of twigs that are tied to wires 50 m from the origin at up to 0.03."""
    sleep_duration: Positive = 0.5
    """[s] A tree is tested for sleep after its joints have been slow for this time. DERIVED: longer than any swing is
    slow at its turning point."""
    sleep_speed: Positive = 2e-3
    """[m/s] A tree falls asleep only if all its points are slower than this. TUNED: 0.07 mm between two pictures."""
    sleep_distance: Positive = 2e-4
    """[m] A tree falls asleep only if all its points are closer than this to their rest positions. TUNED."""

    # ------------------------------------------------------------------ wind
    wind_radius: Positive = 4.0
    """[m] If robots or people are present, wind is simulated only on trees whose root is closer than this to one of
    them; the motion of all other trees in the wind is only rendered. DERIVED: trees in gusts never sleep, and a step
    has time for a few hundred awake trees."""
    wind_wake_load: Positive = 0.05
    """[1] A sleeping tree wakes when the drag of the wind on it has changed by this fraction of its weight. TUNED."""
    wind_check_period: Positive = 0.32
    """[s] Period in which the drag of the wind on every sleeping tree is checked once, with an equal number of trees in
    each step. TUNED."""

    # ------------------------------------------------------------------ level of detail of bunches
    detail_duration: Positive = 1.0
    """[s] The berry clusters of a bunch move only while an actor is near. They keep moving for at least this time after
    the last actor has left. TUNED."""
    detail_rate: Positive = 0.05
    """[rad/s] The berry clusters of a tree count as at rest while all of them turn slower than this relative to their
    parent bodies. TUNED."""
    detail_rest_duration: Positive = 0.25
    """[s] Time for which the berry clusters of a tree must be at rest before they are locked to their bunches again.
    DERIVED: longer than a swing is slow at its turning point.
    """

    # ------------------------------------------------------------------ detachment
    detachment_duration: Positive = 0.03
    """[s] A peduncle breaks after it has been overloaded for this time. GUESSED: a peak in one step is not a pull."""
    cutting_strength: Positive = 13.16e6
    """[Pa] Largest cutting force per cross-sectional area of canes. READ: canes of Okuzgozu with leaves, JKSUS 2024
    36:103034. Dormant canes take 13.9e6 to 21.7e6, Ozdemir et al. 2015; see
    :mod:`vinesim.interaction.cutting_force`."""
    peduncle_cutting_strength: Positive = 4.8e6
    """[Pa] Largest cutting force per cross-sectional area of bunches' peduncles. GUESSED: from a strawberry's, see
    :mod:`vinesim.interaction.cutting_force`."""
    cutting_energy_share: Annotated[float, msgspec.Meta(ge=0.01, lt=1.0)] = 0.7853981633974483
    """[1] Energy of a cut as a share of largest force times diameter. DERIVED: pi/4, force along the chord of the
    section; dormant canes 0.27, Ozdemir et al. 2015."""

    # ------------------------------------------------------------------ contacts with plants
    contact_stiffness: Positive = 2e4
    """[N/m] Stiffness of contacts with plants whose pair of materials ``data/materials`` does not list: in the normal
    direction, and tangentially for the spring of friction. GUESSED."""
    contact_damping_time: NotNegative = 0.02
    """[s] Damping of a contact divided by its stiffness. TUNED: two steps of 10 ms."""
    contact_margin: Positive = 0.002
    """[m] A contact between a plant and a movable geom exists if the gap is smaller than this, or smaller than the
    distance by which the gap can close in one step. TUNED."""
    static_contact_margin: Positive = 0.0002
    """[m] A contact of a plant with a static geom (ground, post, wire, old wood) or another branch exists if a step
    brings the gap below this. TUNED."""
    impact_speed: Positive = 0.3
    """[m/s] A contact whose gap closes faster than this is an impact: the tree in contact is integrated with backward
    Euler (:attr:`phi` = 1). TUNED."""
    max_separation_speed: Positive = 1.0
    """[m/s] Largest speed at which the contact solver separates overlapping bodies. TUNED."""
    contact_capacity: Capacity = 1024
    """Largest number of contacts of plants in one step; if there are more, those with the deepest overlap are kept."""
    max_contacts_per_tree: Capacity = 64
    """Largest number of contacts of one tree."""
    max_static_geoms_per_tree: Capacity = 256
    """Largest number of static geoms near one tree."""
    solver_sweeps: Count = 100
    """Largest number of Gauss-Seidel sweeps of the contact solver in one step; with warm start and Newton steps, two to
    five are usual. TUNED."""
    solver_newton_steps: Annotated[int, msgspec.Meta(ge=0)] = 6
    """Number of first sweeps of the contact solver in an island (bodies coupled by contacts) that are each followed by
    a Newton step. Of the later sweeps, one in ten is followed by a Newton step. TUNED.
    """
    solver_newton_contacts: Annotated[int, msgspec.Meta(ge=0)] = 16
    """Largest number of contacts coupled by plants in an island (bodies coupled by contacts) for which the contact
    solver takes Newton steps. The cost of a Newton step grows with the cube of this number."""
    solver_tolerance: Positive = 1e-6
    """[1] The sweeps of the contact solver end when no contact impulse changes by more than this fraction of the
    largest one. TUNED."""
    solver_constraint_steps: Count = 10
    """Largest number of times that contacts are solved again because the impulses of plants change MuJoCo's constraints
    (supports, limits). DERIVED: with crates that fall beside canes, 7 of 10 steps need none, 1 of 50 needs more."""
    solver_constraint_tolerance: Positive = 1e-3
    """[m/s] Contacts are solved again while MuJoCo's velocities at contacts with plants differ by more than this from
    those assumed by the contact solver. TUNED."""

    # ------------------------------------------------------------------ leaves
    leaves: Literal["ghost", "touch"] = "ghost"
    """Whether leaves touch robots and people (touch) or are only seen (ghost). A leaf that touches is held by the
    spring of its petiole. Leaves never touch other plants, the trellis, boxes or free bunches."""
    petiole_modulus: Positive = 5e8
    """[Pa] Young's modulus of petioles. GUESSED: with it the weight of a grown leaf bends a level petiole of 8 cm by
    0.24 rad. No measurement of a grapevine's petiole was found; Langer et al. 2021, Front. Plant Sci. 12:765605, find
    that petioles of other plants bear 1.7 to 2.9 times the weight of their leaf."""

    # ------------------------------------------------------------------ free bunches
    bunch_rolling_arm: NotNegative = 0.009
    """[m] Lever arm of the rolling resistance of a free (detached) bunch where it is thickest; thinner parts have a
    proportionally smaller one. DERIVED: a bunch that lies on three berries rolls when its centre of mass passes the
    edge between two of them. In the packed bunches of table grapes this is 8.4 to 9.3 mm away across the bunch, in the
    mean of all faces on which they can lie. No measurement was found; berries and pedicels that yield are ignored."""
    bunch_contact_time: Positive = 0.02
    """[s] Time constant of a free bunch's contacts (MuJoCo's solref). TUNED: with a longer one the bunch never comes to
    rest."""
    bunch_contact_damping_ratio: Positive = 3.0
    """[1] Damping ratio of a free bunch's contacts (MuJoCo's solref). TUNED: with 1, a bunch that fell a metre into a
    crate leaves it at up to 110 m/s."""
    bunch_pool_size: Annotated[int, msgspec.Meta(ge=0, le=1024)] = 12
    """Number of MuJoCo bodies kept ready for free (detached) bunches; when all are used, MuJoCo's model is recompiled
    with more (about 10 ms)."""
    dormant_radius: Positive = 2.5
    """[m] A free (detached) bunch far from all actors is dormant: it is rendered but has no MuJoCo body. It gets its
    body when the horizontal distance to an actor is below this. DERIVED: seconds before an arm can reach the bunch."""

    # ------------------------------------------------------------------ robots
    base_slip: Positive = 0.01
    """[m or rad] Offset of a robot's base from its target at which the tracks exert their full effort. With a larger
    offset the tracks slip. TUNED."""
    remote_base_slip: Positive = 0.05
    """[m or rad] Offset of a base from its target at which the tracks exert their full effort, for copies of robots
    that other clients simulate. TUNED.
    """
    base_damping_time: Positive = 0.05
    """[s] Damping of the servos that move a robot's base, divided by their stiffness. TUNED."""

    # ------------------------------------------------------------------ people
    hand_stiffness: Positive = 100.0
    """[N/m] Stiffness of the spring that pulls a person's hand in contact to its tracked controller. READ: CANOPIES
    D6.4, section 3.1.1."""
    hand_force: Positive = 100.0
    """[N] Largest force of a person's hand. READ: CANOPIES D6.4, section 3.1.1."""
    hand_torsional_stiffness: Positive = 10.0
    """[N m/rad] Stiffness of the torsional spring that turns a person's hand in contact to its tracked controller.
    GUESSED."""
    hand_moment: Positive = 10.0
    """[N m] Largest moment of a hand. GUESSED: the strength of a wrist."""
    hand_mass: Positive = 0.4
    """[kg] Mass of a hand. READ: 0.6 % of a person's mass (Winter, Biomechanics and Motor Control, 2009)."""
    hand_inertia: Positive = 0.02
    """[kg m^2] Moment of inertia of a hand. GUESSED: the forearm turns with the hand."""
    hand_contact_duration: Positive = 0.05
    """[s] In contact, a spring pulls a person's hand to its tracked controller; without contact, the hand follows the
    controller exactly. The spring remains for this time after the last contact, so that a bounce does not free the
    hand. TUNED."""
    hand_return_time: Positive = 0.1
    """[s] Time constant with which a person's hand returns to its tracked controller after a contact. TUNED."""
    hand_return_speed: Positive = 1.5
    """[m/s] Largest speed, relative to the tracked controller, of a person's hand that returns to it after a contact.
    TUNED."""
    max_body_speed: Positive = 5.0
    """[m/s] Upper limit of the speed of a person's parts in contacts, for higher speeds in tracking data. GUESSED."""
    teleport_distance: Positive = 0.5
    """[m] A person whose head moves further than this in a step was teleported: the velocity of the person is then set
    to zero. GUESSED."""
    grasp_distance: Positive = 0.03
    """[m] A person's hand that closes grasps objects closer than this to its palm or fingers. GUESSED."""
    grasp_duration: Positive = 0.2
    """[s] Time for which a person's hand that closed without grasping anything still grasps a body that touches the
    hand. GUESSED."""
    haptic_period: Positive = 0.05
    """[s] Period at which a lasting contact of a person's hand is reported to its controller as a vibration.
    GUESSED."""
    haptic_onset_amplitude: Fraction = 0.2
    """[1] Smallest amplitude of the vibration at the onset of a contact of a person's hand, strong enough to be felt.
    GUESSED."""
    haptic_min_amplitude: Fraction = 0.01
    """[1] Amplitude of vibration below which a contact of a person's hand is not reported to its controller.
    GUESSED."""

    # ------------------------------------------------------------------ support of boxes and free bunches
    support_rest_duration: Positive = 0.5
    """[s] A box or free bunch is at rest after it has been still relative to its support (ground, box or link of a
    robot) for this time. DERIVED: as ``sleep_duration``."""
    support_move_speed: Positive = 0.01
    """[m/s] A box faster than this counts as moving, even if it stays near the pose on its support from which its
    displacement is measured. TUNED."""
    support_snap_distance: Positive = 0.5
    """[m] Distance between the copy of a box or bunch and the pose received from another client, above which the copy
    is set to the received pose at once. GUESSED."""

    def __post_init__(self) -> None:
        """Check every number, because msgspec checks only values that were read from a file."""
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
        """Returns the number of steps in a ``duration`` [s], rounded, at least 1."""
        return max(1, round(duration / self.dt))


def _trouble(annotation: Any, value: Any) -> str:
    """Returns a text that describes the valid values of a parameter; empty if ``value`` is valid."""
    kind = msgspec.inspect.type_info(annotation)
    if isinstance(kind, msgspec.inspect.BoolType):
        return "" if isinstance(value, bool) else "True or False"
    if isinstance(kind, msgspec.inspect.LiteralType):
        return "" if value in kind.values else " or ".join(repr(known) for known in kind.values)
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
