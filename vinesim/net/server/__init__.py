"""The server of worlds: it admits actors, keeps retained state on disk and has the clock. It simulates nothing."""
