"""The tick: plants in Warp, rigid bodies in MuJoCo, one shared contact solve."""
