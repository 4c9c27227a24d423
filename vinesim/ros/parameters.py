"""Parameters of a node that can be set while it runs (``ros2 param set``): typed, described, with ranges."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import rclpy.node
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.parameter import Parameter


class Parameters:
    """The parameters of one node. The receiving thread changes them; every thread may read them."""

    def __init__(self, node: rclpy.node.Node) -> None:
        self._node = node
        self._values: dict[str, Any] = {}
        self._defaults: dict[str, Any] = {}
        self._changed: dict[str, Callable[[], None]] = {}
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._take)

    def declare(
        self,
        name: str,
        default: float,
        description: str,
        between: tuple[float, float] | None = None,
        changed: Callable[[], None] | None = None,
    ) -> None:
        """Declare a parameter of the type of its ``default``: bool, int or float.

        A value in the parameter file of the node counts from the start; :class:`ValueError` if it is none.

        ``between``: the least and the greatest value of a number. ``changed`` is called after it was set.
        """  # fmt: skip
        descriptor = ParameterDescriptor(description=description)
        if between is not None and isinstance(default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(between[0]), to_value=int(between[1]))]
        elif between is not None:
            descriptor.floating_point_range = [FloatingPointRange(from_value=between[0], to_value=between[1])]
        self._values[name] = self._defaults[name] = default
        try:
            self._values[name] = self._node.declare_parameter(name, default, descriptor).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            raise ValueError(" ".join(str(error).split())) from error
        if changed is not None:
            self._changed[name] = changed

    def apply_initial(self) -> None:
        """Tell of values that are not the defaults; once all are declared."""
        for name, changed in self._changed.items():
            if self._values[name] != self._defaults[name]:
                changed()

    def __getitem__(self, name: str) -> Any:
        return self._values[name]

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        """Refuse what rclpy lets through: it compares with ranges, and NaN is neither below nor above."""
        for one in parameters:
            if isinstance(one.value, float) and not math.isfinite(one.value):
                reason = f"parameter {one.name} is {one.value}; give a finite number"
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _take(self, parameters: list[Parameter]) -> None:
        for one in parameters:
            if one.name in self._values:
                self._values[one.name] = one.value
        for one in parameters:
            if one.name in self._changed:
                self._changed[one.name]()
