"""What every other package builds on: frames, arrays, files, errors, progress."""
