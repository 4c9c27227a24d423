"""One module for each family of published topics."""
