"""Kernels of wires and arms: the coupling of their shoots, the contacts with wires, and the shapes of deflected wires."""
