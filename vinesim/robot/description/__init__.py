"""Robot descriptions: URDF, and a TOML file beside it with what a URDF cannot express."""
