"""Plants: the articulated-body solver, sleep, level of detail, faults, gradients.

In a step: ``level_of_detail`` refines trees, ``articulation_solver`` predicts, contacts are
solved, ``articulation_solver`` integrates, ``fault_guard`` stops faulty trees,
``sleep`` puts quiet trees to sleep. ``articulation_solver`` is made of ``validation`` (checks of the model),
``device_buffers`` (arrays for host and device), ``kernel_launches`` (kernels bound to them), ``step_runner`` (threads
and graphs), ``ties`` and ``berry_clusters``. ``rollout`` differentiates many steps.
"""
