"""All encoders and decoders of network messages under one name; the modules beside this one define them.

``header`` (magic, version, kind, count, time), ``robot``, ``human``, ``trees``, ``objects``, ``wrenches`` and
``couplings`` hold packed binary messages that travel many times a second; ``control`` and ``meshes`` hold the
rare messages in msgpack.
"""

from __future__ import annotations

from vinesim.net.codec.control import MAX_RECORDS as MAX_RECORDS
from vinesim.net.codec.control import ClockMessage as ClockMessage
from vinesim.net.codec.control import Hello as Hello
from vinesim.net.codec.control import RetainedRecord as RetainedRecord
from vinesim.net.codec.control import Welcome as Welcome
from vinesim.net.codec.control import decode_claims as decode_claims
from vinesim.net.codec.control import decode_hello as decode_hello
from vinesim.net.codec.control import decode_records as decode_records
from vinesim.net.codec.control import decode_time as decode_time
from vinesim.net.codec.control import decode_welcome as decode_welcome
from vinesim.net.codec.control import encode_claims as encode_claims
from vinesim.net.codec.control import encode_hello as encode_hello
from vinesim.net.codec.control import encode_records as encode_records
from vinesim.net.codec.control import encode_time as encode_time
from vinesim.net.codec.control import encode_welcome as encode_welcome
from vinesim.net.codec.header import HEADER as HEADER
from vinesim.net.codec.header import LARGEST_COORDINATE as LARGEST_COORDINATE
from vinesim.net.codec.header import MAGIC as MAGIC
from vinesim.net.codec.header import MAX_COORDINATE as MAX_COORDINATE
from vinesim.net.codec.header import MAX_DATAGRAM as MAX_DATAGRAM
from vinesim.net.codec.header import MAX_MESSAGE as MAX_MESSAGE
from vinesim.net.codec.header import PROTOCOL as PROTOCOL
from vinesim.net.codec.header import TIMESTAMPED as TIMESTAMPED
from vinesim.net.codec.header import MessageError as MessageError
from vinesim.net.codec.header import MessageKind as MessageKind
from vinesim.net.codec.header import WrongVersion as WrongVersion
from vinesim.net.codec.header import is_valid_name as is_valid_name
from vinesim.net.codec.header import kind_of as kind_of
from vinesim.net.codec.header import shift_time as shift_time
from vinesim.net.codec.header import time_of as time_of
from vinesim.net.codec.meshes import MAX_PART as MAX_PART
from vinesim.net.codec.meshes import MeshPart as MeshPart
from vinesim.net.codec.meshes import MeshWanted as MeshWanted
from vinesim.net.codec.meshes import decode_part as decode_part
from vinesim.net.codec.meshes import decode_request as decode_request
from vinesim.net.codec.meshes import decode_wanted as decode_wanted
from vinesim.net.codec.meshes import encode_part as encode_part
from vinesim.net.codec.meshes import encode_request as encode_request
from vinesim.net.codec.meshes import encode_wanted as encode_wanted
from vinesim.net.codec.objects import ObjectStates as ObjectStates
from vinesim.net.codec.objects import check_object_id as check_object_id
from vinesim.net.codec.objects import decode_objects as decode_objects
from vinesim.net.codec.objects import encode_objects as encode_objects
from vinesim.net.codec.robot import MAX_JOINTS as MAX_JOINTS
from vinesim.net.codec.robot import decode_robot as decode_robot
from vinesim.net.codec.robot import encode_robot as encode_robot
from vinesim.net.codec.trees import MAX_TREES as MAX_TREES
from vinesim.net.codec.trees import RESTING as RESTING
from vinesim.net.codec.trees import TOUCHED as TOUCHED
from vinesim.net.codec.trees import TreeStates as TreeStates
from vinesim.net.codec.trees import decode_trees as decode_trees
from vinesim.net.codec.trees import encode_trees as encode_trees
from vinesim.net.codec.trees import quantise_tree as quantise_tree
