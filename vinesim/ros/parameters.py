"""Parameters of a node that can be set while it runs (``ros2 param set``): typed, described, with ranges."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import rclpy.node
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.parameter import Parameter

_FRAME = re.compile(r"[^/\s]\S*")
"""Pattern of valid frame ids."""


class Parameters:
    """The parameters of one node. Only the node's receiving thread changes them; every thread may read them."""

    def __init__(self, node: rclpy.node.Node, values: Mapping[str, Any] | None = None) -> None:
        """``values``: values of the parameters that were set in an earlier run of the node, by name."""
        self._node = node
        self.set_by_user = dict(values or {})
        """Values of the parameters that were ever set, by name. A change replaces the object."""
        self._values: dict[str, Any] = {}
        self._defaults: dict[str, Any] = {}
        self._changed: dict[str, Callable[[], None]] = {}
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._take)

    def declare(
        self,
        name: str,
        default: float | str,
        description: str,
        between: tuple[float, float] | None = None,
        changed: Callable[[], None] | None = None,
    ) -> None:
        """Declare a parameter with the type of its ``default``: bool, int, float, or str for a frame id.

        Its value is the one that was set in an earlier run, else the one in the node's parameter file, else the
        default. Raises :class:`ValueError` if the value in the file is invalid.

        ``between``: smallest and largest value of a number. ``changed``: function to call after the parameter was set.
        """
        descriptor = ParameterDescriptor(description=description)
        if between is not None and isinstance(default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(between[0]), to_value=int(between[1]))]
        elif between is not None:
            descriptor.floating_point_range = [FloatingPointRange(from_value=between[0], to_value=between[1])]
        before = self.set_by_user
        self._values[name] = before.get(name, default)
        self._defaults[name] = default
        try:
            declared = self._node.declare_parameter(
                name, self._values[name], descriptor, ignore_override=name in before
            )
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            raise ValueError(" ".join(str(error).split())) from error
        self._values[name] = declared.value
        self.set_by_user = before  # rclpy also calls _take for a declaration
        if changed is not None:
            self._changed[name] = changed

    def apply(self) -> None:
        """Call the change handlers of parameters that differ from their defaults. Call it after all declarations."""
        for name, changed in self._changed.items():
            if self._values[name] != self._defaults[name]:
                changed()

    def __getitem__(self, name: str) -> Any:
        return self._values[name]

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        """Refuse values that rclpy accepts but that are invalid: numbers that are not finite (NaN passes rclpy's
        range check) and text that is no frame id."""
        for one in parameters:
            if isinstance(one.value, float) and not math.isfinite(one.value):
                reason = f"parameter {one.name} is {one.value}; give a finite number"
                return SetParametersResult(successful=False, reason=reason)
            if one.name in self._values and isinstance(one.value, str) and not _FRAME.fullmatch(one.value):
                reason = (
                    f"parameter {one.name} is {one.value[:50]!r}; give the name of a frame: no blanks, no leading /"
                )
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _take(self, parameters: list[Parameter]) -> None:
        """Store parameters that were set, then call their change handlers."""
        for one in parameters:
            if one.name in self._values:
                self._values[one.name] = one.value
                self.set_by_user = self.set_by_user | {one.name: one.value}
        for one in parameters:
            if one.name in self._changed:
                self._changed[one.name]()
