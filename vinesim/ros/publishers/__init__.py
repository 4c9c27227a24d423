"""Classes that publish topics: one module for each group of topics."""
