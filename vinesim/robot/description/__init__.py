"""Robot descriptions: a URDF, and a TOML file of the same name with data that a URDF cannot contain."""
