"""Controllers of a robot: joint trajectories, Cartesian motion, grippers, waypoints, admittance."""
