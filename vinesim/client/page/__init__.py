"""Pages of a client: picture, sound, access from other machines, and recordings."""
