"""The command line. ``main`` imports only what the named command needs."""
