"""The peer of the fits is what it says: Stein particles take the shape of a posterior that is known."""

import numpy as np

from vinesim.bench.tuning_peers import stein_descent


def test_stein_particles_take_the_mean_and_the_widths_of_a_normal_distribution():
    mean = np.array([1.0, -2.0])
    deviation = np.array([1.0, 0.5])
    begun = np.random.default_rng(0).uniform(-4.0, 4.0, (60, 2))
    found = stein_descent(lambda x: -(x - mean) / deviation**2, begun, 400, rate=0.05)
    np.testing.assert_allclose(found.mean(0), mean, atol=0.1)
    np.testing.assert_allclose(found.std(0), deviation, rtol=0.25)
