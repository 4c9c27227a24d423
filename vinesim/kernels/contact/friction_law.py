"""The contact law, and the functions that solvers need for it: compressive normal impulse, Coulomb friction cone.

All solvers of contacts with plants call these functions, on a CPU and on a GPU: for islands
(``projected_gauss_seidel``, ``newton``), for batches of worlds (``dense_solver``), and for batches of worlds with
rows in the registers of a GPU (``row_solver``).

A contact has an impulse x = (x_n, x_u, x_v) [N s] along its normal and its tangents, and a residual velocity
r = A x + v_free + bias + compliance x [m/s] along them. The conditions: x_n >= 0, r_n >= 0 and x_n r_n = 0; friction
|x_t| <= mu x_n, with r_t = 0 inside the cone, and r_t opposite to x_t on the cone's surface. They hold if
:func:`relaxed` does not change x. All computations are in double precision.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

SLIDING_SHARE = wp.constant(wp.float64(0.999999))
"""[1] A contact slides if its friction is at least this share of the largest possible friction."""

MIN_IMPULSE_SCALE = wp.constant(wp.float64(1.0e-5))
"""[N s] Lower bound of the impulse to which changes are compared in the test of convergence. TUNED: 1 mN over 10 ms."""


@wp.struct
class Surface:
    """Contact properties of a pair of materials.

    To add a property, add a field here; no other code between :mod:`vinesim.scene.materials` and this law needs a
    change.
    """

    friction: wp.float64
    """[1] Coulomb coefficient."""
    stiffness: wp.float64
    """[N/m] Normal stiffness; also the tangential stiffness of the friction anchor."""
    damping: wp.float64
    """[N s/m] Damping in the normal direction, and of the friction anchor."""
    compliance: wp.float64
    """[m/(N s^2)] 1 / (dt (stiffness dt + damping)), added to the diagonal of the Delassus matrix."""


@wp.struct
class Steps:
    """Factors of a contact's Gauss-Seidel step from residual velocities to changes of impulses."""

    normal: wp.float64
    """[kg] Factor from a residual velocity along the normal to a change of impulse."""
    tangential: wp.float64
    """[kg] Factor from a residual velocity along the tangents to a change of impulse."""
    dragged_u: wp.float64
    """[1/kg] Velocity along the first tangent by a unit impulse along the normal."""
    dragged_v: wp.float64
    """[1/kg] Velocity along the second tangent by a unit impulse along the normal."""


@wp.func
def steps_of(own: wp.mat33d):
    """Returns the step sizes of a contact whose impulses cause velocities ``own`` [1/kg] along its rows.

    ``own`` includes the compliance. The step of friction uses the larger eigenvalue of the tangential block, so that
    the iteration converges.
    """
    one = wp.float64(1.0)
    mean = wp.float64(0.5) * (own[1, 1] + own[2, 2])
    spread = wp.float64(0.5) * (own[1, 1] - own[2, 2])
    eigenvalue = mean + wp.sqrt(spread * spread + own[1, 2] * own[1, 2])
    return Steps(one / own[0, 0], one / eigenvalue, own[1, 0], own[2, 0])


@wp.func
def presses(x: wp.vec3d):
    """Returns whether a contact is closed (its normal impulse is positive)."""
    return x[0] > wp.float64(0.0)


@wp.func
def slides(x: wp.vec3d, surface: Surface):
    """Returns whether the friction of a closed contact is at its limit; otherwise the contact sticks."""
    return wp.sqrt(x[1] * x[1] + x[2] * x[2]) >= surface.friction * x[0] * SLIDING_SHARE


@wp.func
def project_into_cone(x: wp.vec3d, surface: Surface):
    """Returns the impulse inside the friction cone: same direction of friction, limited size, no tensile normal
    impulse.
    """
    normal = wp.max(x[0], wp.float64(0.0))
    tangential = wp.sqrt(x[1] * x[1] + x[2] * x[2])
    limit = surface.friction * normal
    share = wp.float64(1.0)
    if tangential > limit:
        share = limit / tangential
    return wp.vec3d(normal, share * x[1], share * x[2])


@wp.func
def relaxed(x: wp.vec3d, residual: wp.vec3d, steps: Steps, surface: Surface):
    """Returns the impulse after a Gauss-Seidel step of a contact: first its normal impulse, then its friction."""
    zero = wp.float64(0.0)
    normal = wp.max(zero, x[0] - residual[0] * steps.normal)
    if normal == zero:
        return wp.vec3d()
    pressed = normal - x[0]
    fu = x[1] - (residual[1] + steps.dragged_u * pressed) * steps.tangential
    fv = x[2] - (residual[2] + steps.dragged_v * pressed) * steps.tangential
    return project_into_cone(wp.vec3d(normal, fu, fv), surface)


@wp.func
def size_of_change(change: wp.vec3d):
    """Returns the size [N s] of a change of a contact's impulse, by which convergence is judged."""
    return wp.max(wp.abs(change[0]), wp.abs(change[1]) + wp.abs(change[2]))


@wp.func
def linearise_sliding(x: wp.vec3d, residual: wp.vec3d, steps: Steps, surface: Surface):
    """Returns K and g of the linearised friction of a sliding contact about its present state: x_t = K (x_t - step r_t)
    + g x_n.

    Friction is the projection of f = x_t - step r_t on the disk of radius mu x_n, where step is ``steps.tangential``. With
    d = f / |f| its derivatives are K = s (1 - d d^T), s = mu x_n / |f|, and g = mu d (Alart and Curnier, A mixed
    formulation for frictional contact problems prone to Newton like solution methods, 1991).
    """
    one = wp.float64(1.0)
    fu = x[1] - residual[1] * steps.tangential
    fv = x[2] - residual[2] * steps.tangential
    scale = one / wp.max(wp.sqrt(fu * fu + fv * fv), wp.float64(1.0e-30))
    share = wp.min(surface.friction * x[0] * scale, one)
    du = fu * scale
    dv = fv * scale
    uv = -share * du * dv
    turned = wp.mat22d(share * (one - du * du), uv, uv, share * (one - dv * dv))
    return turned, wp.vec2d(surface.friction * du, surface.friction * dv)
