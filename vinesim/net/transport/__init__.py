"""How messages travel: the bus protocol, its implementations over Zenoh and in memory, links and their security."""
