"""Controllers: joint trajectories, Cartesian motion, way points, admittance."""
