"""What the vineyard is: scene files, the constants of a generated model, the state that changes, stable ids."""
