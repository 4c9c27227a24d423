"""``vinesim demo``: a server, robot clients and a stock ROS subscriber, each a process of its own."""
