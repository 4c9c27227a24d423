"""What crosses the network, byte by byte."""
