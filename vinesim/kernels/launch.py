"""A kernel bound to its arrays once, launched many times a second.

Warp packs a kernel's arguments anew at every CPU launch, recorded or not: 10 us for twenty arguments, more than most of
our kernels run. :func:`bind` packs them once and then only calls the compiled function: 1 us.
"""

import ctypes
from collections.abc import Callable

import warp as wp


def bind(kernel: wp.Kernel, inputs: list, outputs: list) -> Callable[[int], None]:
    """A function that launches ``kernel`` on the CPU with so many threads, on the arrays named here.

    The arrays must stay alive and where they are; the function keeps Warp's handles of them.
    """
    command = wp.launch(kernel, 1, inputs=inputs, outputs=outputs, device="cpu", record_cmd=True)
    try:
        forward, bounds, values = command.hooks.forward, command.params[0], command.params[1:]
        fields = [(arg.label, type(value)) for arg, value in zip(kernel.adj.args, values, strict=True)]
        packed = type("Arguments", (ctypes.Structure,), {"_fields_": fields})(*values)
        shape, at_bounds, at_packed = bounds.shape, ctypes.byref(bounds), ctypes.byref(packed)
    except (AttributeError, TypeError, ValueError):  # another Warp: its own way, at its own speed

        def relaunch(threads: int) -> None:
            if threads:
                command.set_dim(threads)
                command.launch()

        return relaunch

    def launch(threads: int) -> None:
        if threads:
            shape[0] = bounds.size = threads
            forward(at_bounds, at_packed)

    launch.keeps = (command, inputs, outputs)  # type: ignore[attr-defined]
    return launch
