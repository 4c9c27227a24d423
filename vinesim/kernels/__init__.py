"""Warp kernels: plain arrays in, plain arrays out; one thread does one thing, and its docstring says what."""
