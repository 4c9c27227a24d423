"""Batches of whole worlds on one device: robots and boxes in mujoco_warp, plants in vinesim's kernels, and one contact
solve a step. The extra ``learn`` installs what this package needs."""
