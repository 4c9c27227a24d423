"""Kernels of trellis wires and cordon arms: coupling of the shoots on them, contacts with wires, shapes of wires."""
