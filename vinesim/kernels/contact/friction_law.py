"""The law of a contact: a normal impulse that pushes only, Coulomb friction inside of a cone, and what solvers need of it.

All solvers of contacts with plants call these functions, on a CPU and on a GPU: islands (``projected_gauss_seidel``,
``newton``), trees of batches (``tree_solver``), and the same with rows in the registers of a GPU (``row_solver``).

A contact has an impulse x = (x_n, x_u, x_v) [N s] along its normal and its tangents, and a residual velocity
r = A x + v_free + bias + compliance x [m/s] along them. The conditions: x_n >= 0, r_n >= 0 and x_n r_n = 0; friction
|x_t| <= mu x_n, where r_t = 0 inside of the cone, and r_t against x_t on it. They hold where :func:`relaxed` leaves x as
it is. In double precision.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

SLIDING_SHARE = wp.constant(wp.float64(0.999999))
"""[1] A contact slides if its friction is at least this share of the largest one."""

MIN_IMPULSE_SCALE = wp.constant(wp.float64(1.0e-5))
"""[N s] The largest impulse counts as at least this when convergence is judged. TUNED: 1 mN over 10 ms."""


@wp.struct
class Surface:
    """What the two materials in contact make of it. A new number of theirs needs a field here, and nothing else on its way
    from :mod:`vinesim.scene.materials` to this law."""

    friction: wp.float64
    """[1] Coulomb coefficient."""
    stiffness: wp.float64
    """[N/m] normal, and as the anchor of friction tangential."""
    damping: wp.float64
    """[N s/m]"""
    compliance: wp.float64
    """[m/(N s^2)] 1 / (dt (stiffness dt + damping)), on the diagonal of the Delassus matrix."""


@wp.struct
class Steps:
    """How far a step of Gauss-Seidel goes."""

    normal: wp.float64
    """[kg] by which a velocity along the normal becomes an impulse."""
    tangential: wp.float64
    """[kg] the same along the tangents."""
    dragged_u: wp.float64
    """[1/kg] velocity along the first tangent by an impulse along the normal."""
    dragged_v: wp.float64
    """[1/kg] the same along the second."""


@wp.func
def steps_of(own: wp.mat33d):
    """The steps of a contact whose impulses cause velocities ``own`` [1/kg] along its rows, compliance included.

    With the larger eigenvalue of the tangential block a step of friction stays inside of the cone's convergence.
    """
    one = wp.float64(1.0)
    mean = wp.float64(0.5) * (own[1, 1] + own[2, 2])
    spread = wp.float64(0.5) * (own[1, 1] - own[2, 2])
    eigenvalue = mean + wp.sqrt(spread * spread + own[1, 2] * own[1, 2])
    return Steps(one / own[0, 0], one / eigenvalue, own[1, 0], own[2, 0])


@wp.func
def presses(x: wp.vec3d):
    """Whether a contact is closed: else it is open."""
    return x[0] > wp.float64(0.0)


@wp.func
def slides(x: wp.vec3d, surface: Surface):
    """Whether the friction of a contact that presses is at its limit: else it sticks."""
    return wp.sqrt(x[1] * x[1] + x[2] * x[2]) >= surface.friction * x[0] * SLIDING_SHARE


@wp.func
def project_into_cone(x: wp.vec3d, surface: Surface):
    """The impulse with friction of the same direction and of its limit at most, and with none that pulls."""
    normal = wp.max(x[0], wp.float64(0.0))
    tangential = wp.sqrt(x[1] * x[1] + x[2] * x[2])
    limit = surface.friction * normal
    share = wp.float64(1.0)
    if tangential > limit:
        share = limit / tangential
    return wp.vec3d(normal, share * x[1], share * x[2])


@wp.func
def relaxed(x: wp.vec3d, residual: wp.vec3d, steps: Steps, surface: Surface):
    """The impulse after a Gauss-Seidel step of a contact, normal and then friction."""
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
    """[N s] How far an impulse has changed, when convergence is judged."""
    return wp.max(wp.abs(change[0]), wp.abs(change[1]) + wp.abs(change[2]))


@wp.func
def linearise_sliding(x: wp.vec3d, residual: wp.vec3d, steps: Steps, surface: Surface):
    """Friction of a sliding contact about the present state: x_t = K (x_t - step r_t) + g x_n. Returns K and g.

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
