"""Controllers: joint trajectories, Cartesian motion, waypoints, admittance."""
