"""Wire formats: one module for each group of messages. ``messages`` lists all kinds of messages and families of
keys."""
