"""Messages with ground truth about the bunches in a picture. Import this module only when vision_msgs can be imported.

All messages for one picture have its stamp and its optical frame, and list the same bunches in the same order. The id
of a detection is the index of the bunch, as in data sets, label images and ``/tf_environment``.
"""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Pose
from sensor_msgs.msg import PointCloud2
from vision_msgs.msg import (
    BoundingBox2D,
    BoundingBox3D,
    Detection2D,
    Detection2DArray,
    Detection3D,
    Detection3DArray,
    LabelInfo,
    ObjectHypothesisWithPose,
    VisionClass,
)

from vinesim.core import frames
from vinesim.ros.messages import convert
from vinesim.scene.ids import Organ
from vinesim.scene.values import Box, BunchTruth, CameraFrame

CLASS_ID = str(int(Organ.BUNCH))
"""Class id of all detections. LabelInfo contains its name."""
BUNCH_POINT = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("u", "<f4"),
        ("v", "<f4"),
        ("seen", "<i4"),
        ("bunch", "<i4"),
        ("berries", "<i4"),
        ("berries_seen", "<i4"),
        ("pixels", "<i4"),
        ("amodal_pixels", "<i4"),
    ]
)
"""A bunch as a point of a cloud. ``x``, ``y``, ``z``: point where to cut [m], NaN once the bunch is picked. ``u``,
``v``: pixel of this point. ``seen``: whether this pixel shows the point. ``bunch``: index of the bunch. ``berries``,
``berries_seen``: its number of berries, and of visible ones. ``pixels``, ``amodal_pixels``: its number of visible
pixels, and their number if nothing hid the bunch."""


def label_info() -> LabelInfo:
    """Returns the classes of detections. In a label image, the class is ``label // LABEL_STRIDE``
    (:mod:`vinesim.scene.ids`)."""
    return LabelInfo(class_map=[VisionClass(class_id=int(organ), class_name=organ.name.lower()) for organ in Organ])


def detections_2d(frame: CameraFrame) -> Detection2DArray:
    """Returns the bounding boxes of the visible pixels of each bunch."""
    header = convert.header(frame.time, frame.info.frame_id)
    detections = []
    for one in frame.bunches or ():
        assert one.visible_box is not None, "frames list only bunches with a visible pixel"
        box = _box_2d(one.visible_box)
        detections.append(Detection2D(header=header, id=str(one.bunch), bbox=box, results=[_hypothesis(frame, one)]))
    return Detection2DArray(header=header, detections=detections)


def detections_3d(frame: CameraFrame) -> Detection3DArray:
    """Returns a bounding box of each bunch with all its parts. The box's x axis points down the rachis."""
    header = convert.header(frame.time, frame.info.frame_id)
    detections = []
    for one in frame.bunches or ():
        result = _hypothesis(frame, one)
        box = BoundingBox3D(center=result.pose.pose)
        box.size.x, box.size.y, box.size.z = one.size.tolist()
        detections.append(Detection3D(header=header, id=str(one.bunch), bbox=box, results=[result]))
    return Detection3DArray(header=header, detections=detections)


def bunch_cloud(frame: CameraFrame) -> PointCloud2:
    """Returns a cloud with one :data:`BUNCH_POINT` per bunch: where to cut, and its berries and pixels."""
    bunches = frame.bunches or ()
    message, points = convert.cloud(frame.time, frame.info.frame_id, BUNCH_POINT, 1, len(bunches))
    into_camera = frames.conjugate(frame.pose[3:])
    for row, one in zip(points[0], bunches, strict=True):
        nowhere = np.full(3, np.nan)
        cut = nowhere if one.cut is None else frames.rotate(into_camera, one.cut - frame.pose[:3])
        row["x"], row["y"], row["z"] = cut
        row["u"], row["v"] = nowhere[:2] if one.cut_pixel is None else one.cut_pixel
        row["seen"], row["bunch"] = one.cut_seen, one.bunch
        row["berries"], row["berries_seen"] = one.berries, one.berries_seen
        row["pixels"], row["amodal_pixels"] = one.pixels, one.amodal_pixels
    message.is_dense = not np.isnan(points["x"]).any()
    return message


def _hypothesis(frame: CameraFrame, one: BunchTruth) -> ObjectHypothesisWithPose:
    """Returns class, pose in the optical frame, and score: the share of the bunch's pixels that nothing hides."""
    result = ObjectHypothesisWithPose()
    result.hypothesis.class_id = CLASS_ID
    result.hypothesis.score = 1.0 - one.occlusion
    result.pose.pose = _pose(frames.compose(frames.inverse(frame.pose), one.frame))
    return result


def _pose(values: np.ndarray) -> Pose:
    message = Pose()
    convert.set_vector(message.position, values[:3])
    convert.set_quaternion(message.orientation, values[3:])
    return message


def _box_2d(box: Box) -> BoundingBox2D:
    """Convert a box of pixels. Pixel centres have whole-number coordinates, so the box of one pixel has the size 1."""
    left, top, right, bottom = box
    message = BoundingBox2D(size_x=float(right - left + 1), size_y=float(bottom - top + 1))
    message.center.position.x = 0.5 * (left + right)
    message.center.position.y = 0.5 * (top + bottom)
    return message
