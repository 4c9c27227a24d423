"""Articulated trees with implicit joint springs: kinematics, free motion, impulse response, integration."""
