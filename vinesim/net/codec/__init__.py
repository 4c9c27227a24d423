"""Wire formats: one module for each group of messages; ``messages`` offers them all."""
