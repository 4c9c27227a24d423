"""Tools beside the node."""
