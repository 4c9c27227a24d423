"""Plants that others grow: virtual plants of OpenAlea, Helios or a scanner become trees with wood."""
