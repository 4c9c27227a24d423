"""``vinesim demo``: a server, robot clients and a stock ROS subscriber, each in its own process."""
