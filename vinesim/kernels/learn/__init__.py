"""Kernels of learning tasks (:mod:`vinesim.learn`): observations, rewards and ends of episodes of all worlds."""
