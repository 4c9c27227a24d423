"""Command interfaces of a joint, and the error that an unfit command raises."""

from __future__ import annotations

import enum


class CommandInterface(enum.IntEnum):
    """What a joint is commanded by: the command interfaces of ros2_control, and the motor of a series elastic drive.

    Source: CANOPIES D6.4, sections 5.2 (position, velocity, effort) and 3.1 (series elastic elements).
    """

    POSITION = 0
    """[rad or m]"""
    VELOCITY = 1
    """[rad/s or m/s]"""
    EFFORT = 2
    """[N m or N]"""
    MOTOR_POSITION = 3
    """[rad or m] of the motor behind its spring, seen from the joint."""


class CommandError(ValueError):
    """A command that the robot cannot take; the message names the robot, the joint or group, and the remedy."""
