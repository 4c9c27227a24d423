"""From a scene file to a model: old wood, wires, shoots, leaves and bunches."""
