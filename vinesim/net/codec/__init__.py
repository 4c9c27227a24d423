"""Wire formats: one module for each group of messages; ``messages`` lists every kind and every family of keys."""
