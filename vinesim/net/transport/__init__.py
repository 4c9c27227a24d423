"""Transport of messages: the bus protocol, buses over Zenoh and in memory, endpoints, TLS and access control."""
