"""The server: admission, retained state on disk, clock. It simulates nothing."""
