"""The state of the plants: joint rotations and rates, poses derived from them, awake trees, cut bodies."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core.array_fields import StructOfArrays, array
from vinesim.scene.model import Model


@dataclasses.dataclass
class State(StructOfArrays):
    """State of all plants. The state of rigid bodies (robots, boxes, hands) is in MuJoCo."""

    joint_q: np.ndarray = array("body", 4, unit="1", fill=(0.0, 0.0, 0.0, 1.0))
    """Rotation of the body in its joint frame, xyzw."""
    joint_qd: np.ndarray = array("body", 3, unit="rad/s")
    """Angular velocity of the body against its parent, in joint-frame axes."""
    body_q: np.ndarray = array("body", 7, unit="m, 1", fill=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    """World pose (position, quaternion xyzw), derived from ``joint_q``."""
    body_qd: np.ndarray = array("body", 6, unit="m/s, rad/s")
    """World velocity of the body's origin, then angular velocity, derived from ``joint_qd``."""
    body_cut: np.ndarray = array("body", unit="1", dtype=np.bool_)
    """Whether the body has been cut off its parent. A cut body is the floating root of its descendants: ``joint_q`` is
    its rotation in the world and ``joint_qd`` its angular velocity in world axes."""
    joint_x: np.ndarray = array("body", 3, unit="m")
    """World position of the origin of a cut body; unused for other bodies."""
    joint_xd: np.ndarray = array("body", 3, unit="m/s")
    """World velocity of the origin of a cut body; unused for other bodies."""
    tree_fine: np.ndarray = array("tree", unit="1", dtype=np.bool_)
    """Whether the berry clusters (groups of berries) of the tree's bunches move as separate bodies; if not, each bunch
    is one rigid body."""
    tree_awake: np.ndarray = array("tree", unit="1", dtype=np.bool_)
    bunch_attached: np.ndarray = array("bunch", unit="1", dtype=np.bool_, fill=1)
    cut_segment: np.ndarray = array("bunch", unit="1", dtype=np.int32, fill=-1)
    """Body of the segment of its peduncle in which each bunch was cut off; -1: it hangs, or has parted at its own
    joint."""
    cut_at: np.ndarray = array("bunch", unit="m")
    """Distance of that cut from the segment's origin."""
    stump_of: np.ndarray = array("body", unit="1", dtype=np.int32, fill=-1)
    """For a spare body that a cut has made a stump: the body that was cut, of which it was the part before the cut. -1
    for all other bodies. A stump has the frame of that body."""
    stump_end: np.ndarray = array("body", unit="m")
    """Distance of that cut from the origin of the frame, where the stump ends; 0 for all other bodies."""

    @classmethod
    def at_rest(cls, model: Model) -> State:
        """Returns the state with all trees asleep and without motion in the shape that their generator or builder
        gave them (``Model.joint_settled``)."""
        counts = model.counts()
        state = cls.allocate(body=counts["body"], tree=counts["tree"], bunch=counts["bunch"])
        state.joint_q[:] = model.joint_settled
        state.body_q[:] = model.forward_kinematics(state.joint_q)
        return state
