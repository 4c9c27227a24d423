"""Base layer of all other packages: frames, arrays, files, errors, progress."""
