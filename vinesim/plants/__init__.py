"""Plants: the articulated-body solver, sleep, level of detail, faults, gradients.

In a step ``level_of_detail`` refines trees, ``articulation_solver`` predicts, contacts are solved,
``articulation_solver`` integrates, ``fault_guard`` stops faulty trees, and ``sleep`` puts quiet trees to sleep.
``articulation_solver`` uses ``validation`` (checks of the model), ``device_buffers`` (arrays for host and device) and
``ties``. ``rollout`` differentiates many steps.
"""
