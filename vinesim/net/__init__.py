"""Network: wire formats, transport, replication of objects, the server, and recordings."""
