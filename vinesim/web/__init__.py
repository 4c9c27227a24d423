"""Server and messages of the page on which people and spectators see the vineyard."""
