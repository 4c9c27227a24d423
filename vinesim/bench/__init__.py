"""Measurements that users may want to repeat on their machine, each compared with a peer: ``vinesim bench``."""
