"""The vineyard as data: scene files, constants of a generated model, changing state, stable ids."""
